/** The HTTP API, as far as the console uses it. The session travels in a cookie that no script can read. */
import { learnServerTime, now } from "./clock";
import type { AckStatus, Reason } from "./protocol";

export interface Account {
  id: string;
  name: string;
  session: string;
}

/** How one may sign in here; `open_id`: at a provider elsewhere. */
export interface Methods {
  password: boolean;
  open_id: { name: string; address: string } | null;
}

export interface SignInSession {
  id: string;
  how: "link" | "password" | "open-id";
  since: string;
  address: string;
  program: string;
  mine: boolean;
}

export interface Lease {
  holder: string;
  epoch: number;
  expires_at: string;
  mine: boolean;
}

export interface Device {
  id: string;
  name: string;
  label: string;
  kind: string;
  robot_type: string;
  agent: string;
  space: string;
  /** What this account may do with it. A viewer watches, and changes nothing. */
  role: "owner" | "operator" | "viewer";
  owner: { id: string; name: string };
  topic: string;
  online: boolean;
  last_seen_at: string | null;
  lease: Lease | null;
}

export interface Granted {
  epoch: number;
  holder: string;
  expires_at: string;
  lease_ms: number;
  confirmed: boolean;
}

export interface Movement {
  name: string;
  description: string;
  version: number;
  built_in: boolean;
}

export type ActionStatus = AckStatus | "queued" | "created" | "published";

export interface Action {
  id: string;
  device: string;
  status: ActionStatus;
  epoch: number;
  who: string;
  reason: Reason | null;
  progress: number | null;
  output: string;
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

export type Purpose = { purpose: "watch" } | { purpose: "control"; device: string; epoch: number };

export interface Space {
  id: string;
  name: string;
}

interface SignedIn {
  account: { id: string; name: string };
  session: string;
  csrf_token: string;
}

interface Page<T> {
  items: T[];
  cursor: string | null;
}

/** The server said no (a problem document), or could not be reached (`status` 0). The message is fit for the page. */
export class ApiError extends Error {
  override name = "ApiError";
  readonly status: number;
  /** The last part of the problem's type, such as `lease-held`; `unreachable` where there was no answer. */
  readonly code: string;
  readonly extra: Readonly<Record<string, unknown>>;

  constructor(status: number, code: string, message: string, extra: Record<string, unknown> = {}) {
    super(message);
    this.status = status;
    this.code = code;
    this.extra = extra;
  }
}

/** How long one call may take, beside what it asked the server to wait [ms]. */
const TIMEOUT_MS = 10_000;

interface CallOptions {
  body?: unknown;
  /** What the server was asked to wait before it answers [ms]. */
  waitMs?: number;
  headers?: Record<string, string>;
  /** Let the call outlive the page. */
  keepalive?: boolean;
  /** It was refused once for want of the session's token. */
  again?: boolean;
}

/** One method for each call. All of them throw `ApiError`, and nothing else. */
export class Api {
  readonly #base: string;
  /** What goes with the cookie in calls that change something: a page of another site cannot know it. */
  #csrf = "";

  constructor(base = "/api/v1") {
    this.#base = base;
  }

  async signIn(link: string): Promise<Account> {
    return this.#signedIn(await this.#call("POST", "/auth/sign-in", { body: { link } }));
  }

  async signInByPassword(name: string, password: string): Promise<Account> {
    return this.#signedIn(await this.#call("POST", "/auth/password", { body: { name, password } }));
  }

  methods(): Promise<Methods> {
    return this.#call("GET", "/auth/methods");
  }

  async setPassword(password: string, old: string): Promise<void> {
    const body = old === "" ? { password } : { password, old_password: old };
    await this.#call("PUT", "/accounts/me/password", { body });
  }

  sessions(): Promise<SignInSession[]> {
    return this.#all("/accounts/me/sessions");
  }

  async endSession(id: string): Promise<void> {
    await this.#call("DELETE", `/accounts/me/sessions/${id}`);
  }

  async endOtherSessions(): Promise<void> {
    await this.#call("DELETE", "/accounts/me/sessions");
  }

  async signOut(): Promise<void> {
    await this.#call("POST", "/auth/sign-out");
  }

  async me(): Promise<Account> {
    const { csrf_token: csrf, ...account } = await this.#call<Account & { csrf_token: string | null }>("GET", "/accounts/me");
    this.#csrf = csrf ?? "";
    return account;
  }

  devices(): Promise<Device[]> {
    return this.#all("/devices");
  }

  spaces(): Promise<Space[]> {
    return this.#all("/spaces");
  }

  async claim(code: string): Promise<Device[]> {
    const answer = await this.#call<{ devices: Device[] }>("POST", "/agents/claim", { body: { code } });
    return answer.devices;
  }

  takeLease(device: string, leaseMs: number): Promise<Granted> {
    const waitMs = 1000;
    return this.#call("POST", `/devices/${device}/lease`, { body: { lease_ms: leaseMs, wait_ms: waitMs }, waitMs });
  }

  renewLease(device: string, leaseMs: number, epoch: number): Promise<Granted> {
    return this.#call("POST", `/devices/${device}/lease`, { body: { lease_ms: leaseMs, epoch } });
  }

  async lease(device: string): Promise<Lease | null> {
    return (await this.#call<{ lease: Lease | null }>("GET", `/devices/${device}/lease`)).lease;
  }

  async releaseLease(device: string, epoch: number, leaving = false): Promise<void> {
    await this.#call("DELETE", `/devices/${device}/lease?epoch=${epoch}`, { keepalive: leaving });
  }

  /** What can be run on a device: its owner's movements for its robot type, and those that come with the type. */
  movements(device: string): Promise<Movement[]> {
    return this.#all(`/devices/${device}/movements`);
  }

  runMovement(device: string, name: string, epoch: number | null, key: string): Promise<Action> {
    const waitMs = 3000;
    const request = { kind: "run_movement", name, parameters: {} };
    const body = { request, wait_ms: waitMs, wait_for: "started", ...(epoch === null ? {} : { epoch }) };
    return this.#call("POST", `/devices/${device}/actions`, { body, waitMs, headers: { "Idempotency-Key": key } });
  }

  action(id: string, waitMs: number): Promise<Action> {
    return this.#call("GET", `/actions/${id}?wait_ms=${waitMs}&wait_for=done`, { waitMs });
  }

  cancelAction(id: string): Promise<Action> {
    return this.#call("POST", `/actions/${id}/cancel`);
  }

  stop(device: string, reason: string): Promise<{ confirmed: boolean }> {
    return this.#call("POST", `/devices/${device}/stop`, { body: { reason }, keepalive: true });
  }

  resetStop(device: string): Promise<{ confirmed: boolean }> {
    return this.#call("POST", `/devices/${device}/stop/reset`);
  }

  credentials(purpose: Purpose): Promise<Credentials> {
    return this.#call("POST", "/mqtt/credentials", { body: purpose });
  }

  #signedIn(answer: SignedIn): Account {
    this.#csrf = answer.csrf_token;
    return { ...answer.account, session: answer.session };
  }

  async #all<T>(path: string): Promise<T[]> {
    const items: T[] = [];
    let cursor: string | null = null;
    do {
      const query: string = cursor === null ? "" : `?cursor=${encodeURIComponent(cursor)}`;
      const page: Page<T> = await this.#call<Page<T>>("GET", path + query);
      items.push(...page.items);
      cursor = page.cursor;
    } while (cursor !== null);
    return items;
  }

  async #call<T>(method: string, path: string, options: CallOptions = {}): Promise<T> {
    const headers: Record<string, string> = { Accept: "application/json", ...options.headers };
    if (method !== "GET") headers["X-CSRF-Token"] = this.#csrf;
    if (options.body !== undefined) headers["Content-Type"] = "application/json";
    const askedAt = now();
    let response: Response;
    let text: string;
    try {
      response = await fetch(this.#base + path, {
        method,
        headers,
        credentials: "same-origin",
        body: options.body === undefined ? null : JSON.stringify(options.body),
        keepalive: options.keepalive ?? false,
        signal: AbortSignal.timeout(TIMEOUT_MS + (options.waitMs ?? 0)),
      });
      text = await response.text();
    } catch (error) {
      const late = error instanceof DOMException && error.name === "TimeoutError";
      throw new ApiError(0, "unreachable", late ? "The server did not answer in time." : "The server cannot be reached.");
    }
    const serverMs = response.headers.get("X-Telescope-Time-Ms");
    if (serverMs !== null) learnServerTime(Number(serverMs), askedAt, now());
    const body = parseBody(text, response.status);
    if (response.ok) return body as T;
    const refused = problem(response.status, body);
    // Signed in anew in another tab: the cookie is the new session's, and so has the token to be.
    if (refused.code !== "csrf-token" || options.again === true) throw refused;
    await this.me();
    return this.#call(method, path, { ...options, again: true });
  }
}

function parseBody(text: string, status: number): unknown {
  if (text === "") return null;
  try {
    return JSON.parse(text);
  } catch {
    throw new ApiError(status, "not-json", `The server answered ${status} with something that is not JSON.`);
  }
}

function problem(status: number, body: unknown): ApiError {
  const given = (typeof body === "object" && body !== null ? body : {}) as Record<string, unknown>;
  const said = [given["detail"], given["title"]].find((text) => typeof text === "string" && text !== "");
  const type = typeof given["type"] === "string" ? given["type"] : "";
  const message = typeof said === "string" ? said : `The server answered ${status}.`;
  return new ApiError(status, type.split("/").pop() ?? "", message, given);
}

/** An error's sentence for the page. */
export function sentence(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}
