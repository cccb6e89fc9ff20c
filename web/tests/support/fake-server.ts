/** A server behind `fetch` whose responses the test sets; it records each call. */
import { vi } from "vitest";
import { Api } from "../../src/shared/api/client";

interface Call {
  /** Method and path without the query, such as `POST /devices/a1-arm/stop`. */
  route: string;
  query: URLSearchParams;
  body: Record<string, unknown>;
  headers: Record<string, string>;
}

export interface Answer {
  status: number;
  body?: unknown;
  headers?: Record<string, string>;
}

export const ok = (body: unknown): Answer => ({ status: 200, body });
export const none: Answer = { status: 204 };
export const list = (...items: unknown[]): Answer => ok({ items, cursor: null });
export const problem = (status: number, code: string, detail: string): Answer => ({ status, body: { type: `/problems/${code}`, detail } });

/** For a handler: the server cannot be reached. */
export function unreachable(): never {
  throw new TypeError("fetch failed");
}

/** After construction, every `fetch` reaches this server until `vi.unstubAllGlobals()`. */
export class FakeServer {
  readonly calls: Call[] = [];
  readonly #handlers = new Map<string, (call: Call) => Answer | Promise<Answer>>();
  readonly api = new Api("");

  constructor() {
    vi.stubGlobal("fetch", async (address: string, init: RequestInit) => {
      const [path = "", query = ""] = address.split("?");
      const call: Call = {
        route: `${init.method ?? ""} ${path}`,
        query: new URLSearchParams(query),
        body: typeof init.body === "string" ? (JSON.parse(init.body) as Call["body"]) : {},
        headers: init.headers as Record<string, string>,
      };
      this.calls.push(call);
      const handler = this.#handlers.get(call.route);
      const { status, body, headers } = handler === undefined ? problem(404, "not-found", `No response for ${call.route}.`) : await handler(call);
      return new Response(body === undefined ? null : JSON.stringify(body), { status, ...(headers && { headers }) });
    });
  }

  /** Sets the response to a route, or what computes it; replaces the previous one. */
  on(route: string, answer: Answer | ((call: Call) => Answer | Promise<Answer>)): void {
    this.#handlers.set(route, typeof answer === "function" ? answer : () => answer);
  }

  callsTo(route: string): Call[] {
    return this.calls.filter((call) => call.route === route);
  }
}
