/** Stored latency samples over the HTTP API. */
import type { Http } from "./http";

export const TRANSPORTS = ["mqtt", "websocket", "http", "http-poll", "xmpp"] as const;
/** `http`: long polling; `http-poll`: polling at an interval. */
export type Transport = (typeof TRANSPORTS)[number];

export const PATHS = [
  "command-started",
  "command-answered",
  "received-started",
  "operator-device",
  "operator-cloud",
  "device-cloud",
] as const;
/** The measured path. Each path uses one clock. */
export type Path = (typeof PATHS)[number];

export interface Sample {
  /** Time of the measurement on the measuring side's clock [ms since 1970]. */
  atMs: number;
  ms: number;
}

/** Statistics of one transport and path from the cloud. */
export interface StoredLatency {
  transport: Transport;
  path: Path;
  /** Count over the whole period, like the statistics; may exceed the number of stored samples. */
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

  /** Measures one HTTP round trip to the server's health endpoint. */
  async measureRoundTrip(): Promise<void> {
    await this.#http.call("GET", "/health");
  }
}
