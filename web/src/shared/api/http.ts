/** HTTP API calls with an HttpOnly session cookie. All failures are `ApiError`. */
import { updateServerTime, now } from "../lib/clock";
import { newId } from "../lib/ids";

export interface Page<T> {
  items: T[];
  cursor: string | null;
}

/** The server rejected the call (a problem document) or was unreachable (`status` 0). The message can be displayed. */
export class ApiError extends Error {
  override name = "ApiError";
  readonly status: number;
  /** The last part of the problem's type, such as `lease-held`; `unreachable` without a response. */
  readonly code: string;
  readonly extra: Readonly<Record<string, unknown>>;

  constructor(status: number, code: string, message: string, extra: Record<string, unknown> = {}) {
    super(message);
    this.status = status;
    this.code = code;
    this.extra = extra;
  }
}

/** Timeout of one call, in addition to the server-side wait [ms]. */
const TIMEOUT_MS = 10_000;
/** Status of an error whose cause is only in the server's log. */
const UNEXPECTED = 500;

interface CallOptions {
  body?: unknown;
  /** Requested server-side wait [ms]. */
  waitMs?: number;
  headers?: Record<string, string>;
  /** Completes the call after the page closes. */
  keepalive?: boolean;
  /** Whether the call is a retry after a missing CSRF token. */
  retried?: boolean;
}

export interface Tagged<T> {
  body: T;
  /** null: the response has none. */
  etag: string | null;
}

/** All methods throw only `ApiError`. */
export class Http {
  readonly #base: string;
  /** CSRF token, sent with changing calls. Other sites cannot read it. */
  #csrf = "";

  constructor(base: string) {
    this.#base = base;
  }

  /** Sets the CSRF token that this session's responses contain. */
  setCsrfToken(csrf: string): void {
    this.#csrf = csrf;
  }

  /** All pages of a list. */
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
    return (await this.tagged<T>(method, path, options)).body;
  }

  /** Like `call`, with the ETag of the response. */
  async tagged<T>(method: string, path: string, options: CallOptions = {}): Promise<Tagged<T>> {
    const headers: Record<string, string> = { Accept: "application/json", ...options.headers };
    if (method !== "GET") Object.assign(headers, { "X-CSRF-Token": this.#csrf }, newTrace());
    if (options.body !== undefined) headers["Content-Type"] = "application/json";
    const sentAt = now();
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
      const timedOut = error instanceof DOMException && error.name === "TimeoutError";
      throw new ApiError(0, "unreachable", timedOut ? "The server did not respond in time." : "The server cannot be reached.");
    }
    const serverMs = response.headers.get("X-Telescope-Time-Ms");
    if (serverMs !== null) updateServerTime(Number(serverMs), sentAt, now());
    const body = parseBody(text, response.status);
    if (response.ok) return { body: body as T, etag: response.headers.get("ETag") };
    const rejection = problem(response.status, body, response.headers.get("X-Request-Id"));
    // After a new sign-in in another tab the cookie has changed, so use the new session's token.
    if (rejection.code !== "csrf-token" || options.retried === true) throw rejection;
    const { csrf_token: csrf } = await this.call<{ csrf_token: string | null }>("GET", "/accounts/me");
    this.setCsrfToken(csrf ?? "");
    return this.tagged(method, path, { ...options, retried: true });
  }
}

function parseBody(text: string, status: number): unknown {
  if (text === "") return null;
  try {
    return JSON.parse(text);
  } catch {
    throw new ApiError(status, "not-json", `The server's response with status ${status} is not valid JSON.`);
  }
}

/** Headers that begin a trace (W3C Trace Context, sampled). The request id in the server's log is the trace id. */
function newTrace(): Record<string, string> {
  const trace = newId();
  return { "X-Request-Id": trace, traceparent: `00-${trace}-${newId().slice(0, 16)}-01` };
}

function problem(status: number, body: unknown, request: string | null): ApiError {
  const fields = (typeof body === "object" && body !== null ? body : {}) as Record<string, unknown>;
  const detail = [fields["detail"], fields["title"]].find((text) => typeof text === "string" && text !== "");
  const type = typeof fields["type"] === "string" ? fields["type"] : "";
  const message = typeof detail === "string" ? detail : `The server responded with status ${status}.`;
  const reference = status === UNEXPECTED && request !== null ? ` Request ID: ${request}` : "";
  return new ApiError(status, type.split("/").pop() ?? "", message + reference, fields);
}

/** Whether the server rejects a request for credentials, so that repeating it is of no use. */
export function isRefusal(error: unknown): boolean {
  return error instanceof ApiError && [401, 403, 404, 409].includes(error.status);
}

/** An error as a sentence for display. */
export function sentence(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}
