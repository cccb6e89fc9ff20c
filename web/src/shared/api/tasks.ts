/** Tasks of robot types, their trials and success rates over the HTTP API. */
import type { Http, Page } from "./http";

/** Success rate with its 95 % Wilson interval. `rate` is null without counted trials. */
export interface Rate {
  trials: number;
  successes: number;
  /** Trials whose end was not observed; they do not count. */
  unknown: number;
  rate: number | null;
  lower: number;
  upper: number;
}

export interface Task {
  name: string;
  label: string;
  description: string;
  movement: string;
  parameters: Record<string, unknown>;
  time_limit_s: number;
  observed: "simulation" | "measurement";
  /** The condition as the manifest declares it. */
  success: Record<string, unknown>;
  /** Whether a trial resets objects to a seed. */
  resets: boolean;
  rate: Rate;
}

/** Simulated trials that were run with the command line and published. */
export interface Batch {
  first_seed: number;
  causes: Record<string, number>;
  software: string;
  type_version: number;
  published_at: string;
  published_by: string;
  rate: Rate;
}

export interface TaskReport extends Task {
  devices: { device: string; rate: Rate }[];
  /** `type_version` null: not reported. */
  versions: { type_version: number | null; rate: Rate }[];
  /** `at`: first moment of the day in UTC. */
  days: { at: string; rate: Rate }[];
  batches: Batch[];
  /** Whether all trials were evaluated; else the oldest are missing. */
  complete: boolean;
}

export type TrialState = "running" | "success" | "failed" | "unknown";

export interface Trial {
  action: string;
  device: string;
  state: TrialState;
  cause: string;
  detail: string;
  seed: number | null;
  epoch: number;
  caller: string;
  started_at: string;
  ended_at: string | null;
  /** Simulated time in a simulation [s]. */
  duration_s: number | null;
  movement: string;
  movement_version: number;
  simulated: boolean | null;
  software: string | null;
  type_version: number | null;
}

/** Empty texts: no filter. */
export interface TrialFilter {
  device: string;
  state: TrialState | "";
}

/** All methods throw only `ApiError`. */
export class TasksApi {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  async list(robotType: string): Promise<Task[]> {
    return (await this.#http.call<{ items: Task[] }>("GET", path(robotType))).items;
  }

  get(robotType: string, task: string): Promise<TaskReport> {
    return this.#http.call("GET", path(robotType, task));
  }

  /** Trials, newest first. */
  trials(robotType: string, task: string, filter: TrialFilter, cursor: string | null, limit: number): Promise<Page<Trial>> {
    const query = new URLSearchParams({ limit: String(limit) });
    if (filter.device !== "") query.set("device", filter.device);
    if (filter.state !== "") query.set("state", filter.state);
    if (cursor !== null) query.set("cursor", cursor);
    return this.#http.call("GET", `${path(robotType, task)}/trials?${query.toString()}`);
  }
}

function path(robotType: string, task?: string): string {
  const tasks = `/robot-types/${encodeURIComponent(robotType)}/tasks`;
  return task === undefined ? tasks : `${tasks}/${encodeURIComponent(task)}`;
}
