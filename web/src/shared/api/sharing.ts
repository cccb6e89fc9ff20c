/** Wire types of shares, invitations, API keys and the audit log. */

export type Role = "owner" | "operator" | "viewer";
export type SharedRole = Exclude<Role, "owner">;

export interface Person {
  id: string;
  name: string;
}

/** Kinds of shared resources. */
export interface Target {
  kind: "device" | "space";
  id: string;
}

export interface Share {
  account: Person;
  role: SharedRole;
  created_by: string;
  created_at: string;
  /** `null`: no expiry. */
  expires_at: string | null;
}

/** An invitation. `role` `owner`: a transfer of ownership. */
export interface Invitation {
  id: string;
  kind: "device" | "space" | "agent";
  target: string;
  label: string;
  role: Role;
  created_by: string;
  created_by_account: string;
  uses: number;
  /** Duration of the role after acceptance [s]; `null`: no expiry. */
  share_s: number | null;
  expires_at: string;
  /** The only account that may redeem it, shown to the owner; `null`: any account with the secret. */
  account: Person | null;
}

/** The secret and its link are returned only in this response. */
export interface CreatedInvitation extends Invitation {
  secret: string;
  link: string;
}

export interface InvitationSettings {
  role: SharedRole;
  expires_in_s: number;
  uses: number;
  share_s: number | null;
}

export interface ApiKeySettings {
  name: string;
  role: SharedRole;
  /** Device ids and `space:<id>`; empty: everything the account can access. */
  only: string[];
  days: number;
}

export interface ApiKey extends Omit<ApiKeySettings, "days"> {
  id: string;
  created_at: string;
  expires_at: string;
  expired: boolean;
  /** Accurate to one hour. */
  last_used_at: string | null;
}

export interface CreatedApiKey {
  api_key: ApiKey;
  /** Returned only in this response. */
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

/** Filter; empty or `null`: all entries. */
export interface AuditQuery {
  event: string;
  /** The subject in the log: a device id, `device:<id>` or `space:<id>` for shares, `key:<id>`. */
  target: string;
  sinceMs: number | null;
  untilMs: number | null;
}
