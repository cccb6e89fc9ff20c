/** Stored latency samples over the HTTP API. */
import type { Http } from "./http";

export const TRANSPORTS = ["mqtt", "websocket", "http", "http-poll", "xmpp"] as const;
/** `http` is long polling where an agent does it; `http-poll` asks at an interval. */
export type Transport = (typeof TRANSPORTS)[number];

export const PATHS = [
  "command-started",
  "command-answered",
  "received-started",
  "operator-device",
  "operator-cloud",
  "device-cloud",
] as const;
/** From where to where; each is measured on one clock. */
export type Path = (typeof PATHS)[number];

export interface Sample {
  /** By the clock of who measured [ms since 1970]. */
  atMs: number;
  ms: number;
}

/** One transport and path, as the cloud tells it. */
export interface StoredLatency {
  transport: Transport;
  path: Path;
  /** Of the whole span, and so are the figures: there may be more than samples are kept. */
  count: number;
  mean_ms: number | null;
  max_ms: number | null;
  p50_ms: number | null;
  p95_ms: number | null;
  p99_ms: number | null;
  /** The newest raw samples, independent of the requested period. */
  at_ms: number[];
  ms: number[];
}

export class LatencyApi {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  async of(device: string, fromMs: number): Promise<StoredLatency[]> {
    const { items } = await this.#http.call<{ items: StoredLatency[] }>("GET", `/devices/${device}/latency?from=${Math.round(fromMs)}`);
    return items;
  }

  /** Ask the server whether it is well: there and back over HTTP. */
  async ask(): Promise<void> {
    await this.#http.call("GET", "/health");
  }
}
