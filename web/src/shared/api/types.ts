/** Responses and parameters of the HTTP API. */
import type { AckStatus, Reason } from "../mqtt/protocol.generated";
import type { Person, Role } from "./sharing";

export interface Account {
  id: string;
  name: string;
  session: string;
  /** Whether the account may read the state of the server. */
  administrator: boolean;
}

/** Stored recordings, captures, movements and robot types of the account [bytes]. */
export interface StorageUsage {
  used_bytes: number;
  limit_bytes: number;
}

/** Available sign-in methods; `oidc`: OpenID Connect provider. */
export interface SignInMethods {
  password: boolean;
  oidc: { name: string; url: string } | null;
}

export interface SignInSession {
  id: string;
  method: "link" | "password" | "oidc";
  created_at: string;
  /** Accurate to five minutes. */
  last_used_at: string;
  /** Of the last use. */
  address: string;
  /** User agent of the last use. */
  program: string;
  mine: boolean;
}

/** A request for control. `ended`: the requested lease ended for another reason. */
export interface ControlRequestInfo {
  id: string;
  requester: string;
  requester_account: string;
  epoch: number;
  mine: boolean;
  requested_at: string;
  expires_at: string;
  outcome: "open" | "accepted" | "rejected" | "withdrawn" | "expired" | "ended";
}

export interface Lease {
  holder: string;
  holder_account: string;
  epoch: number;
  expires_at: string;
  mine: boolean;
  /** The reason for taking it from another operator. */
  reason?: string;
  /** The open request. */
  request?: ControlRequestInfo | null;
}

/** Another viewer of a device. `mine`: this account in another session. */
export interface Watcher {
  name: string;
  account: string;
  role: Role;
  mine: boolean;
  since: string;
}

export interface Device {
  id: string;
  name: string;
  label: string;
  kind: string;
  robot_type: string;
  agent: string;
  space: string;
  /** This account's role on the device. A viewer has read access only. */
  role: Role;
  owner: Person;
  topic: string;
  online: boolean;
  /** Why the agent and the server cannot work together, and which of them to update. */
  incompatible: string | null;
  last_seen_at: string | null;
  lease: Lease | null;
  /** Transports by which a page can send setpoints. */
  setpoints_over: ("mqtt" | "xmpp")[];
}

export interface GrantedLease {
  epoch: number;
  holder: string;
  expires_at: string;
  lease_ms: number;
  confirmed: boolean;
  /** Authenticates the setpoints of this lease; secret. */
  setpoint_key: string;
  /** Whether setpoints reach the device; otherwise only actions move it. */
  streaming: boolean;
}

/** `reason`: why the device rejected the reset; `null` also if it has not responded. */
export interface ResetConfirmation {
  confirmed: boolean;
  reason: Reason | null;
}

/** `unknown`: the device has not reported the outcome in time; its report ends the action. */
export type ActionStatus = AckStatus | "queued" | "created" | "published" | "unknown";

export interface Action {
  id: string;
  device: string;
  status: ActionStatus;
  epoch: number;
  caller: string;
  reason: Reason | null;
  progress: number | null;
  output: string;
  result: Record<string, unknown>;
}

/** Latency samples of one kind, measured on this page's clock. */
export interface LatencyBatch {
  transport: "websocket" | "http";
  path: "operator-device" | "operator-cloud";
  samples: readonly { at_ms: number; ms: number }[];
}

/** A captured file. */
export interface Upload {
  id: string;
  stream: string;
  name: string;
  at: string;
  content_type: string;
  length: number;
  verified: boolean;
}

/** A section of a stream. With `raw` samples, `mean` is the value and the other lists are empty. */
export interface Series {
  resolution: string;
  span_ms: number;
  at_ms: number[];
  fields: Record<string, { mean: (number | null)[]; min: (number | null)[]; max: (number | null)[]; last: (number | null)[] }>;
}

export interface Credentials {
  client_id: string;
  username: string;
  password: string;
  lifetime_s: number;
  publish: string[];
  subscribe: string[];
  websocket_url: string;
}

/** For setpoints over XMPP. The token signs in at the gateway and expires with the password. */
export interface XmppCredentials {
  jid: string;
  password: string;
  token: string;
  lifetime_s: number;
  /** Bare JID of the gateways. */
  cloud: string;
  websocket_url: string;
}

export interface ControlPurpose {
  purpose: "control";
  device: string;
  epoch: number;
}

export type Purpose = { purpose: "view" } | ControlPurpose;

export interface Space {
  id: string;
  name: string;
  role: Role;
  owner: Person;
}

export interface ActionCallOptions {
  /** Epoch of the lease held here; `null`: the cloud takes a lease for the duration of the action. */
  epoch: number | null;
  waitFor?: "started" | "done";
  /** The device ends the action after this time [ms]. */
  timeoutMs?: number;
}
