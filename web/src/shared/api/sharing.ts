/** Who may do what, on the wire: shares, invitations, API keys, and the record of what was done. */

export type Role = "owner" | "operator" | "viewer";
export type SharedRole = Exclude<Role, "owner">;

export interface Person {
  id: string;
  name: string;
}

/** What can be shared. */
export interface Target {
  kind: "device" | "space";
  id: string;
}

export interface Share {
  account: Person;
  role: SharedRole;
  created_by: string;
  created_at: string;
  /** `null`: until it is ended. */
  expires_at: string | null;
}

/** `role` `owner`: something changes hands. */
export interface Invitation {
  id: string;
  kind: "device" | "space" | "agent";
  target: string;
  label: string;
  role: Role;
  created_by: string;
  uses: number;
  /** How long the part lasts from when it is taken [s]; `null`: until it is ended. */
  share_s: number | null;
  expires_at: string;
  /** The only account that may redeem it, shown to the owner; `null`: any account with the secret. */
  account: Person | null;
}

/** The secret and its link are returned only in this response. */
export interface InvitationMade extends Invitation {
  secret: string;
  link: string;
}

export interface InvitationWanted {
  role: SharedRole;
  expires_in_s: number;
  uses: number;
  share_s: number | null;
}

export interface ApiKeyWanted {
  name: string;
  role: SharedRole;
  /** Ids of devices, and `space:<id>`; empty: all that the account may see. */
  only: string[];
  days: number;
}

export interface ApiKey extends Omit<ApiKeyWanted, "days"> {
  id: string;
  created_at: string;
  expires_at: string;
  expired: boolean;
  /** Right to the hour. */
  last_used_at: string | null;
}

export interface ApiKeyMade {
  api_key: ApiKey;
  /** Told this once. */
  token: string;
}

export type Outcome = "done" | "rejected" | "failed" | "unknown";

export interface AuditRecord {
  seq: number;
  at: string;
  event: string;
  target: string;
  outcome: Outcome;
  actor: string;
  account: string;
  session: string;
  key: string;
  data: Record<string, unknown>;
  hash: string;
}

export interface AuditPage {
  items: AuditRecord[];
  cursor: string | null;
}

/** Empty and `null`: everything. */
export interface AuditQuery {
  event: string;
  /** As the record names it: a device's id, `device:<id>` and `space:<id>` of shares, `key:<id>`. */
  target: string;
  sinceMs: number | null;
  untilMs: number | null;
}
