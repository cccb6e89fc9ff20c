/** Calls to the HTTP API: one session in a cookie that no script can read, one error for all that can go wrong. */
import { learnServerTime, now } from "../lib/clock";

export interface Page<T> {
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

export interface CallOptions {
  body?: unknown;
  /** What the server was asked to wait before it answers [ms]. */
  waitMs?: number;
  headers?: Record<string, string>;
  /** Let the call outlive the page. */
  keepalive?: boolean;
  /** It was refused once for want of the session's token. */
  again?: boolean;
}

/** All of its methods throw `ApiError`, and nothing else. */
export class Http {
  readonly #base: string;
  /** What goes with the cookie in calls that change something: a page of another site cannot know it. */
  #csrf = "";

  constructor(base: string) {
    this.#base = base;
  }

  /** The token that this session's answers brought. */
  trust(csrf: string): void {
    this.#csrf = csrf;
  }

  /** Every page of a list. */
  async all<T>(path: string): Promise<T[]> {
    const items: T[] = [];
    let cursor: string | null = null;
    do {
      const query: string = cursor === null ? "" : `?cursor=${encodeURIComponent(cursor)}`;
      const page: Page<T> = await this.call<Page<T>>("GET", path + query);
      items.push(...page.items);
      cursor = page.cursor;
    } while (cursor !== null);
    return items;
  }

  async call<T>(method: string, path: string, options: CallOptions = {}): Promise<T> {
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
    const { csrf_token: csrf } = await this.call<{ csrf_token: string | null }>("GET", "/accounts/me");
    this.trust(csrf ?? "");
    return this.call(method, path, { ...options, again: true });
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
