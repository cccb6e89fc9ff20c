/** The movement library: list, save, check, and run one movement on several robots. */
import type { Action } from "./types";
import { ApiError, type Http } from "./http";

/** Parameters of a movement: a subset of JSON Schema, with units. */
export type Schema = {
  title?: string;
  description?: string;
  unit?: string;
  default?: unknown;
} & (
  | { type: "number"; minimum?: number; maximum?: number; exclusiveMinimum?: number; exclusiveMaximum?: number }
  | { type: "integer"; minimum?: number; maximum?: number }
  | { type: "string"; enum?: string[]; minLength?: number; maxLength?: number }
  | { type: "boolean" }
  | { type: "array"; items: Schema; minItems?: number; maxItems?: number }
  | ObjectSchema
);

export interface ObjectSchema {
  type: "object";
  properties?: Record<string, Schema>;
  required?: string[];
  additionalProperties?: boolean;
}

export type Parameters = Record<string, unknown>;

export interface Movement {
  name: string;
  description: string;
  version: number;
  sha256: string;
  updated_at: string;
  built_in: boolean;
  /** `null`: accepts any parameters. */
  parameters_schema: ObjectSchema | null;
}

export interface MovementSource extends Movement {
  source: string;
}

export interface RobotTypeEntry {
  type: string;
  label: string;
  kind: string;
  built_in: boolean;
  state: "checking" | "ready" | "rejected";
}

/** A finding in a script: lines from 1, columns from 0 [characters]. An `error` prevents saving. */
export interface Mark {
  severity: "error" | "warning";
  message: string;
  line: number;
  column: number;
  end_line: number;
  end_column: number;
}

export interface CheckResult {
  diagnostics: Mark[];
  savable: boolean;
  description: string;
  parameters_schema: ObjectSchema | null;
}

export interface ScriptParameter {
  name: string;
  kind: "positional" | "keyword" | "rest";
  type?: string;
  default?: string;
  /** The kind of names that its strings refer to. */
  names?: string;
}

export interface ScriptCall {
  name: string;
  signature: string;
  doc: string;
  details?: string;
  parameters?: ScriptParameter[];
}

interface ScriptValue {
  name: string;
  type: string;
  doc: string;
  attributes?: ScriptValue[];
  methods?: ScriptCall[];
}

/** The script API and the robot type's names: `joints`, `frames`, `postures` … */
export interface Scripting {
  api: { values: ScriptValue[]; functions: ScriptCall[]; modules: string[] };
  names: Record<string, string[]>;
}

/** The result for one device: its action, or the reason for a rejection. */
interface FleetItem {
  device: string;
  status: number;
  action: Action | null;
  problem: { detail: string } | null;
}

/** The script was not saved, because a version newer than its base exists. */
export class MovementChanged extends ApiError {
  override name = "MovementChanged";
  /** The newest version; 0: the movement was deleted. */
  readonly version: number;

  constructor(error: ApiError) {
    super(error.status, error.code, error.message, error.extra);
    this.version = Number(error.extra["version"]);
  }
}

/** All methods throw only `ApiError`. */
export class Library {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  robotTypes(): Promise<RobotTypeEntry[]> {
    return this.#http.all("/robot-types");
  }

  list(robotType: string): Promise<Movement[]> {
    return this.#http.all(at(robotType));
  }

  /** The newest version, or the requested one. */
  get(robotType: string, name: string, version?: number): Promise<MovementSource> {
    return this.#http.call("GET", at(robotType, name) + (version === undefined ? "" : `?version=${version}`));
  }

  /** Newest first. */
  versions(robotType: string, name: string): Promise<Movement[]> {
    return this.#http.all(`${at(robotType, name)}/versions`);
  }

  /**
   * Saves a new version. `basedOn`: its base version, 0 for a new movement.
   * Throws `MovementChanged` if a newer version exists, and `ApiError` with `extra.line` for a syntax error.
   */
  async save(robotType: string, name: string, source: string, basedOn: number): Promise<Movement> {
    try {
      return await this.#http.call("PUT", at(robotType, name), { body: { source, based_on: basedOn } });
    } catch (error) {
      throw error instanceof ApiError && error.code === "movement-changed" ? new MovementChanged(error) : error;
    }
  }

  /** Deletes all versions of an own movement; a built-in one of the same name becomes visible again. */
  async remove(robotType: string, name: string): Promise<void> {
    await this.#http.call("DELETE", at(robotType, name));
  }

  check(robotType: string, source: string): Promise<CheckResult> {
    return this.#http.call("POST", `/robot-types/${encodeURIComponent(robotType)}/scripting/check`, { body: { source } });
  }

  scripting(robotType: string): Promise<Scripting> {
    return this.#http.call("GET", `/robot-types/${encodeURIComponent(robotType)}/scripting`);
  }

  /** Runs a movement on several devices; returns a result per device. `epochs`: lease epochs by device. */
  async runOnMany(
    devices: readonly string[],
    movement: string,
    parameters: Parameters,
    epochs: Readonly<Record<string, number>>,
    key: string,
  ): Promise<FleetItem[]> {
    const request = { kind: "run_movement", name: movement, parameters };
    const body = { devices, request, epochs, wait_ms: 3000, wait_for: "started" };
    const headers = { "Idempotency-Key": key };
    const { items } = await this.#http.call<{ items: FleetItem[] }>("POST", "/actions", { body, waitMs: 3000, headers });
    return items;
  }
}

function at(robotType: string, name?: string): string {
  const movements = `/robot-types/${encodeURIComponent(robotType)}/movements`;
  return name === undefined ? movements : `${movements}/${encodeURIComponent(name)}`;
}
