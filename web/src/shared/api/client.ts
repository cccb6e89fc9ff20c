/** The HTTP API calls of the console. The session uses an HttpOnly cookie. */
import type { Account, Action, ActionCallOptions, ControlPurpose, ControlRequestInfo, Credentials, Device, GrantedLease, LatencyBatch, Lease, Purpose, ResetConfirmation, Series, SignInMethods, Space, StorageUsage, Upload, Watcher, XmppCredentials } from "./types";
import { AccountApi } from "./account";
import { AutonomyApi } from "./autonomy";
import { HealthApi } from "./health";
import { LatencyApi } from "./latency";
import { Http, type Page } from "./http";
import { Library, type Movement } from "./movement-library";
import type { AnyRequest } from "./action-requests";
import type {
  ApiKey, CreatedApiKey, ApiKeySettings, AuditPage, AuditQuery, Invitation, CreatedInvitation, InvitationSettings, Share,
  SharedRole, Target,
} from "./sharing";
import { RecordingsApi } from "./recordings";
import { RobotTypes } from "./robot-types";
import { TasksApi } from "./tasks";
import { Transfers } from "./transfers";

export type { Movement };

interface SignedIn {
  account: { id: string; name: string };
  session: string;
  csrf_token: string;
  device_token: string;
}

/** What a sign-in sends in addition; empty: not sent. */
export interface SignInExtras {
  /** Of the authenticator app, or a recovery code. */
  code: string;
  /** Of an earlier sign-in of this browser. */
  deviceToken: string;
}

/** One method per call. All methods throw only `ApiError`. */
export class Api {
  readonly #http: Http;
  /** The signed-in account. */
  readonly account: AccountApi;
  /** Sessions and autonomy of devices. */
  readonly autonomy: AutonomyApi;
  /** Device health. */
  readonly health: HealthApi;
  readonly library: Library;
  readonly recordings: RecordingsApi;
  readonly robotTypes: RobotTypes;
  /** Tasks of robot types and their trials. */
  readonly tasks: TasksApi;
  /** Latency samples. */
  readonly latency: LatencyApi;
  readonly transfers: Transfers;

  constructor(base = "/api/v1") {
    this.#http = new Http(base);
    this.account = new AccountApi(this.#http);
    this.autonomy = new AutonomyApi(this.#http);
    this.health = new HealthApi(this.#http);
    this.library = new Library(this.#http);
    this.recordings = new RecordingsApi(this.#http);
    this.robotTypes = new RobotTypes(this.#http);
    this.tasks = new TasksApi(this.#http);
    this.latency = new LatencyApi(this.#http);
    this.transfers = new Transfers(this.#http);
  }

  /** Returns the token that marks this browser as known. */
  async signIn(link: string, extras: SignInExtras): Promise<string> {
    return this.#signedIn(await this.#http.call("POST", "/auth/sign-in", { body: { link, ...sent(extras) } }));
  }

  /** Like `signIn`. */
  async signInByPassword(name: string, password: string, extras: SignInExtras): Promise<string> {
    return this.#signedIn(await this.#http.call("POST", "/auth/password", { body: { name, password, ...sent(extras) } }));
  }

  /** Creates an account with an invitation's secret, signs in and redeems the invitation. Returns like `signIn`. */
  async createAccount(invitation: string, name: string, password: string): Promise<string> {
    return this.#signedIn(await this.#http.call("POST", "/auth/accounts", { body: { invitation, name, password } }));
  }

  /** The URL of the external sign-in, with an invitation for users without an account. */
  async startOpenIdSignIn(invitation: string): Promise<string> {
    return (await this.#http.call<{ url: string }>("POST", "/auth/oidc/start", { body: { invitation } })).url;
  }

  signInMethods(): Promise<SignInMethods> {
    return this.#http.call("GET", "/auth/methods");
  }

  async signOut(): Promise<void> {
    await this.#http.call("POST", "/auth/sign-out");
  }

  async me(): Promise<Account> {
    const { csrf_token: csrf, ...account } = await this.#http.call<Account & { csrf_token: string | null }>("GET", "/accounts/me");
    this.#http.setCsrfToken(csrf ?? "");
    return account;
  }

  async storage(): Promise<StorageUsage> {
    return (await this.#http.call<{ storage: StorageUsage }>("GET", "/accounts/me")).storage;
  }

  devices(): Promise<Device[]> {
    return this.#http.all("/devices");
  }

  spaces(): Promise<Space[]> {
    return this.#http.all("/spaces");
  }

  createSpace(name: string): Promise<Space> {
    return this.#http.call("POST", "/spaces", { body: { name } });
  }

  shares(target: Target): Promise<Share[]> {
    return this.#http.all(`${at(target)}/shares`);
  }

  /** Creates or changes a share; `forS` null: no expiry [s]. */
  share(target: Target, account: string, role: SharedRole, durationS: number | null): Promise<Share> {
    return this.#http.call("POST", `${at(target)}/shares`, { body: { account, role, expires_in_s: durationS } });
  }

  /** Removes a share. Returns a description of revocations that the broker has not confirmed, or "". */
  async unshare(target: Target, account: string): Promise<string> {
    const unfinished = await this.#http.call<{ detail: string } | null>("DELETE", `${at(target)}/shares/${account}`);
    return unfinished?.detail ?? "";
  }

  invitations(target: Target): Promise<Invitation[]> {
    return this.#http.all(`${at(target)}/invitations`);
  }

  invite(target: Target, settings: InvitationSettings): Promise<CreatedInvitation> {
    return this.#http.call("POST", `${at(target)}/invitations`, { body: settings });
  }

  async withdrawInvitation(target: Target, id: string): Promise<void> {
    await this.#http.call("DELETE", `${at(target)}/invitations/${id}`);
  }

  previewInvitation(secret: string): Promise<Invitation> {
    return this.#http.call("POST", "/invitations/lookup", { body: { secret } });
  }

  redeemInvitation(secret: string, space: string | null): Promise<Invitation> {
    return this.#http.call("POST", "/invitations/redeem", { body: space === null ? { secret } : { secret, space } });
  }

  apiKeys(): Promise<ApiKey[]> {
    return this.#http.all("/api-keys");
  }

  createApiKey(settings: ApiKeySettings): Promise<CreatedApiKey> {
    return this.#http.call("POST", "/api-keys", { body: settings });
  }

  async revokeApiKey(id: string): Promise<void> {
    await this.#http.call("DELETE", `/api-keys/${id}`);
  }

  /** One page of the account's audit log, newest first. */
  audit(query: AuditQuery, cursor: string | null, limit: number): Promise<AuditPage> {
    const parameters = new URLSearchParams({ limit: String(limit) });
    if (query.event !== "") parameters.set("event", query.event);
    if (query.target !== "") parameters.set("target", query.target);
    if (query.sinceMs !== null) parameters.set("from", String(query.sinceMs));
    if (query.untilMs !== null) parameters.set("to", String(query.untilMs));
    if (cursor !== null) parameters.set("cursor", cursor);
    return this.#http.call("GET", `/accounts/me/audit?${parameters.toString()}`);
  }

  /** Pairs an agent by its claim code; `space` null: the account's first space. */
  async claim(code: string, space: string | null = null): Promise<Device[]> {
    const body = space === null ? { code } : { code, space };
    const response = await this.#http.call<{ devices: Device[] }>("POST", "/agents/claim", { body });
    return response.devices;
  }

  takeLease(device: string, leaseMs: number): Promise<GrantedLease> {
    const waitMs = 1000;
    return this.#http.call("POST", `/devices/${device}/lease`, { body: { lease_ms: leaseMs, wait_ms: waitMs }, waitMs });
  }

  renewLease(device: string, leaseMs: number, epoch: number): Promise<GrantedLease> {
    return this.#http.call("POST", `/devices/${device}/lease`, { body: { lease_ms: leaseMs, epoch } });
  }

  async lease(device: string): Promise<Lease | null> {
    return (await this.#http.call<{ lease: Lease | null }>("GET", `/devices/${device}/lease`)).lease;
  }

  async releaseLease(device: string, epoch: number, leaving = false): Promise<void> {
    await this.#http.call("DELETE", `/devices/${device}/lease?epoch=${epoch}`, { keepalive: leaving });
  }

  /** Takes control from the current operator, who sees the reason. For owners. */
  takeOver(device: string, leaseMs: number, reason: string): Promise<GrantedLease> {
    const waitMs = 1000;
    const body = { lease_ms: leaseMs, wait_ms: waitMs, take_over: true, reason };
    return this.#http.call("POST", `/devices/${device}/lease`, { body, waitMs });
  }

  /** Requests control from the lease holder; `confirmed`: the device displays the request. */
  requestControl(device: string, withinMs: number): Promise<{ request: ControlRequestInfo; confirmed: boolean }> {
    const waitMs = 1000;
    return this.#http.call("POST", requests(device), { body: { within_ms: withinMs, wait_ms: waitMs }, waitMs });
  }

  controlRequest(device: string, id: string): Promise<ControlRequestInfo> {
    return this.#http.call("GET", `${requests(device)}/${id}`);
  }

  /** Hands this session's control over to the requester, or rejects the request. */
  async respondToRequest(device: string, id: string, accept: boolean): Promise<void> {
    await this.#http.call("POST", `${requests(device)}/${id}/${accept ? "accept" : "reject"}`);
  }

  async withdrawRequest(device: string, id: string, leaving = false): Promise<void> {
    await this.#http.call("DELETE", `${requests(device)}/${id}`, { keepalive: leaving });
  }

  /** Reports this page as a viewer of a device and returns the other viewers. */
  watch(device: string): Promise<{ items: Watcher[]; refresh_ms: number }> {
    return this.#http.call("PUT", `/devices/${device}/viewers`);
  }

  async unwatch(device: string): Promise<void> {
    await this.#http.call("DELETE", `/devices/${device}/viewers`, { keepalive: true });
  }

  /** Renames a device; `null`: use its agent's name. */
  rename(device: string, label: string | null): Promise<Device> {
    return this.#http.call("PUT", `/devices/${device}/label`, { body: { label } });
  }

  /** Movements available on a device: its owner's for the robot type, and the built-in ones. */
  movements(device: string): Promise<Movement[]> {
    return this.#http.all(`/devices/${device}/movements`);
  }

  /** Starts an action. Returns when it reaches the requested status, or after a timeout. */
  startAction(device: string, request: AnyRequest, { epoch, waitFor, timeoutMs }: ActionCallOptions, key: string): Promise<Action> {
    const waitMs = waitFor === "done" ? 10_000 : 3_000;
    const body = {
      request,
      wait_ms: waitMs,
      wait_for: waitFor ?? "started",
      ...(timeoutMs === undefined ? {} : { timeout_ms: timeoutMs }),
      ...(epoch === null ? {} : { epoch }),
    };
    return this.#http.call("POST", `/devices/${device}/actions`, { body, waitMs, headers: { "Idempotency-Key": key } });
  }

  /** Uploads latency samples of this page. */
  async addLatency(device: string, batch: LatencyBatch, key: string): Promise<void> {
    await this.#http.call("POST", `/devices/${device}/latency`, { body: batch, headers: { "Idempotency-Key": key } });
  }

  /** The newest captured files of a device. */
  async uploads(device: string, limit: number): Promise<Upload[]> {
    return (await this.#http.call<Page<Upload>>("GET", `/devices/${device}/uploads?limit=${limit}`)).items;
  }

  /** One captured file, with a content URL that is valid for one hour. */
  upload(device: string, id: string): Promise<Upload & { url: string }> {
    return this.#http.call("GET", `/devices/${device}/uploads/${id}`);
  }

  /** A stream's measurements between two times [ms since 1970], reduced to a maximum number of points. */
  series(device: string, stream: string, fromMs: number, points: number, field: string): Promise<Series> {
    const query = new URLSearchParams({ from: String(Math.round(fromMs)), points: String(points), fields: field });
    return this.#http.call("GET", `/devices/${device}/data/${stream}?${query.toString()}`);
  }

  action(id: string, waitMs: number): Promise<Action> {
    return this.#http.call("GET", `/actions/${id}?wait_ms=${waitMs}&wait_for=done`, { waitMs });
  }

  cancelAction(id: string): Promise<Action> {
    return this.#http.call("POST", `/actions/${id}/cancel`);
  }

  stop(device: string, reason: string): Promise<{ outcome: "confirmed" | "sent" | "unreachable" }> {
    return this.#http.call("POST", `/devices/${device}/stop`, { body: { reason }, keepalive: true });
  }

  resetStop(device: string): Promise<ResetConfirmation> {
    return this.#http.call("POST", `/devices/${device}/stop/reset`);
  }

  credentials(purpose: Purpose): Promise<Credentials> {
    return this.#http.call("POST", "/mqtt/credentials", { body: purpose });
  }

  xmppCredentials(purpose: ControlPurpose): Promise<XmppCredentials> {
    return this.#http.call("POST", "/xmpp/credentials", { body: purpose });
  }

  #signedIn(response: SignedIn): string {
    this.#http.setCsrfToken(response.csrf_token);
    return response.device_token;
  }
}

function sent({ code, deviceToken }: SignInExtras): Record<string, string> {
  return { ...(code === "" ? {} : { code }), ...(deviceToken === "" ? {} : { device_token: deviceToken }) };
}

function requests(device: string): string {
  return `/devices/${device}/lease/requests`;
}

/** The path of a shared device or space. */
function at({ kind, id }: Target): string {
  return `/${kind}s/${id}`;
}
