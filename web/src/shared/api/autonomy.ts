/** Sessions and autonomy of devices over the HTTP API. */
import type { Http, Page } from "./http";

/** Moving time by its source. `hti` and `mti` are null without motion; `mtia` is null if no operator moved the device. */
export interface MotionShare {
  operator_s: number;
  machine_s: number;
  hti: number | null;
  mti: number | null;
  mtia: number | null;
}

/** The time in which one account or action holds the lease of a device. */
export interface StoredSession {
  epoch: number;
  holder: string | null;
  action: string | null;
  /** Movement or kind of the action; null: a person has the lease. */
  task: string | null;
  /** Status of the action. */
  outcome: string | null;
  /** Whether a person ended the action before its end. */
  intervened: boolean;
  started_at: string | null;
  /** null: it lasts. */
  ended_at: string | null;
  share: MotionShare;
  /** Whether a recording is stored. */
  recorded: boolean;
}

/** Sums of the sessions that started in a time span. */
export interface Autonomy {
  share: MotionShare;
  sessions: number;
  actions: number;
  interventions: number;
  /** Median time from a grant to the first motion by its operator [s]. */
  takeover_s: number | null;
  /** Share of the operators' lease time in which they moved the device. */
  workload: number | null;
  /** `at`: first moment of the day in UTC. */
  days: { at: string; share: MotionShare }[];
  tasks: { name: string; share: MotionShare }[];
  /** Whether all sessions of the span were evaluated; else the oldest are missing. */
  complete: boolean;
}

/** All methods throw only `ApiError`. */
export class AutonomyApi {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  /** Autonomy in sessions that started at or after a time [ms since 1970]. */
  of(device: string, fromMs: number): Promise<Autonomy> {
    return this.#http.call("GET", `/devices/${device}/autonomy?from=${fromMs}`);
  }

  /** Sessions, newest first. */
  sessions(device: string, cursor: string | null, limit: number): Promise<Page<StoredSession>> {
    const query = new URLSearchParams({ limit: String(limit), ...(cursor === null ? {} : { cursor }) });
    return this.#http.call("GET", `/devices/${device}/sessions?${query.toString()}`);
  }
}
