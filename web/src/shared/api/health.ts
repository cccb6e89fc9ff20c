/** Health of devices over the HTTP API. */
import type { Http, Page } from "./http";
import type { Event } from "../mqtt/protocol.generated";

export type Severity = Event["severity"];
/** `unknown`: no messages from the device. */
export type HealthState = "ok" | "unknown" | "warning" | "fault";

export interface Fault {
  /** Decreases with time, so that the newest fault sorts first. */
  id: string;
  code: string;
  state: "raised" | "acknowledged" | "cleared";
  /** The source: the device, the detectors, or the cloud (no messages). */
  source: "device" | "detector" | "cloud";
  kind: string;
  severity: Severity;
  message: string;
  stream: string;
  field: string;
  value: number | null;
  baseline: number | null;
  limit: number | null;
  raised_at: string;
  acknowledged_at: string | null;
  acknowledged_by: string;
  cleared_at: string | null;
  /** Occurrence number for its code. */
  count: number;
  worsened: number;
  /** How often its condition has come and gone while the fault was open; the newest time is `last_seen_at`. */
  occurrences: number;
  last_seen_at: string | null;
}

/** One monitored field, averaged over ten seconds. */
export interface MonitoredField {
  stream: string;
  field: string;
  label: string;
  unit: string;
  advice: string;
  value: number;
  baseline: number;
  usual_low: number | null;
  usual_high: number | null;
  warning_low: number | null;
  warning_high: number | null;
  low: number | null;
  high: number | null;
  slope_per_s: number | null;
  /** The limit is reached between these times after `updated_at`, with a probability of 90 %; `null`: uncertain or never. */
  limit_earliest_s: number | null;
  limit_latest_s: number | null;
  findings: string[];
  updated_at: string;
}

interface Counts {
  error: number;
  warning: number;
  info: number;
}

export interface DeviceHealth {
  device: string;
  health: HealthState;
  online: boolean;
  last_seen_at: string | null;
  counts: Counts;
  faults: Fault[];
  fields: MonitoredField[];
}

/** One device in the health list. */
export interface HealthSummary {
  device: string;
  label: string;
  space: string;
  health: HealthState;
  online: boolean;
  last_seen_at: string | null;
  counts: Counts;
  worst: Fault | null;
}

export interface StoredEvent {
  id: string;
  kind: string;
  severity: Severity;
  message: string;
  data: Record<string, unknown>;
  at: string;
}

export interface StoredStream {
  name: string;
  fields: string[];
}

/** Each part is `ok`, or a description of its error. */
export interface ServerHealth {
  broker: string;
  models: string;
}

export type PartStatus = "ok" | "degraded" | "failed";

/** One part of the server; `message` is the cause and the remedy, or a figure. */
export interface ServerPart {
  name: string;
  status: PartStatus;
  message: string;
  since: string;
}

/** The state of the installation, for administrators. Sizes are null for a cloud store. */
export interface Installation {
  status: PartStatus;
  version: string;
  parts: ServerPart[];
  workers: { name: string; host: string; version: string; started_at: string; seen_at: string }[];
  broker: { kind: string; address: string };
  agents_online: number;
  devices_online: number;
  tables_bytes: number | null;
  blobs_bytes: number | null;
  free_bytes: number | null;
  errors: { program: string; at: string; level: string; message: string }[];
}

export const RANK: Readonly<Record<HealthState, number>> = { ok: 0, unknown: 1, warning: 2, fault: 3 };

/** All methods throw only `ApiError`. */
export class HealthApi {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  /** Health of all devices, or those of one space, worst first. */
  async all(space: string | null): Promise<HealthSummary[]> {
    const lines = await this.#http.all<HealthSummary>(space === null ? "/diagnostics" : `/spaces/${space}/diagnostics`);
    return lines.sort((one, other) => RANK[other.health] - RANK[one.health] || one.label.localeCompare(other.label));
  }

  server(): Promise<ServerHealth> {
    return this.#http.call("GET", "/health");
  }

  installation(): Promise<Installation> {
    return this.#http.call("GET", "/administration");
  }

  of(device: string): Promise<DeviceHealth> {
    return this.#http.call("GET", `/devices/${device}/diagnostics`);
  }

  /** Cleared faults, newest first. */
  clearedFaults(device: string, cursor: string | null, limit: number): Promise<Page<Fault>> {
    return this.#http.call("GET", `/devices/${device}/faults?open=false&${paging(cursor, limit)}`);
  }

  acknowledge(device: string, fault: string): Promise<Fault> {
    return this.#http.call("POST", `/devices/${device}/faults/${fault}/acknowledge`);
  }

  /** Events, newest first. */
  events(device: string, cursor: string | null, limit: number): Promise<Page<StoredEvent>> {
    return this.#http.call("GET", `/devices/${device}/events?${paging(cursor, limit)}`);
  }

  streams(device: string): Promise<StoredStream[]> {
    return this.#http.all(`/devices/${device}/data`);
  }
}

function paging(cursor: string | null, limit: number): string {
  return new URLSearchParams({ limit: String(limit), ...(cursor === null ? {} : { cursor }) }).toString();
}
