/** Robot types over the HTTP API: the visible ones, and previews of uploads. */
import type { Http } from "./http";
import { readTwin, type KnownTwin } from "../mqtt/parse-messages";
import type { Joint, MimicJoint, PositionDependentLimit } from "../mqtt/protocol.generated";

type TypeState = "checking" | "ready" | "rejected";

interface TypeUpload {
  version: number;
  state: TypeState;
  errors: string[];
  warnings: string[];
  uploaded_at: string;
}

export interface RobotType {
  type: string;
  label: string;
  kind: string;
  version: number;
  description: string;
  driver: string;
  joints: Joint[];
  frames: string[];
  capabilities: string[];
  home_rad: Record<string, number>;
  mimic_joints: MimicJoint[];
  position_dependent_limits: PositionDependentLimit[];
  postures: string[];
  expressions: string[];
  behaviours: string[];
  /** Actions of the type; each robot's description lists those it accepts. */
  actions: string[];
  streams: { name: string; rate_hz: number }[];
  built_in: boolean;
  state: TypeState;
  /** Name → bytes. */
  files: Record<string, number>;
  upload: TypeUpload | null;
}

/** A temporary upload for checking. Only its owner sees it; it expires. */
export interface TypePreview {
  id: string;
  expires_at: string;
  robot_type: RobotType;
}

/** The displayed model, and its other content. */
export interface TypeModel {
  twin: KnownTwin;
  actuators: string[];
  cameras: string[];
}

interface TypeMovement {
  name: string;
  description: string;
  version: number;
  built_in: boolean;
}

/** An uploaded folder: XML files as text, other files as base64, movements as scripts by name. */
export interface TypeFolder {
  manifest: string;
  files: Record<string, string>;
  movements: Record<string, string>;
}

interface TwinResponse {
  device: string;
  bodies: unknown;
  actuators: string[];
  cameras: string[];
}

/** Timeout of an upload over a slow connection [ms]. */
const UPLOAD_TIMEOUT_MS = 170_000;
/** Requested server-side wait for the validation result [ms]. */
const VALIDATION_WAIT_MS = 20_000;

/** All methods throw only `ApiError`, or `MessageError` for an invalid model. */
export class RobotTypes {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  list(): Promise<RobotType[]> {
    return this.#http.all("/robot-types");
  }

  get(type: string): Promise<RobotType> {
    return this.#http.call("GET", `/robot-types/${type}`);
  }

  model(type: string): Promise<TypeModel> {
    return this.#model(`/robot-types/${type}/twin`);
  }

  movements(type: string): Promise<TypeMovement[]> {
    return this.#http.all(`/robot-types/${type}/movements`);
  }

  putMovement(type: string, name: string, source: string): Promise<TypeMovement> {
    return this.#http.call("PUT", `/robot-types/${type}/movements/${encodeURIComponent(name)}`, { body: { source } });
  }

  async delete(type: string): Promise<void> {
    await this.#http.call("DELETE", `/robot-types/${type}`);
  }

  /** The URL of an archive with all files. */
  archiveAddress(type: string): string {
    return `/api/v1/robot-types/${type}/archive`;
  }

  fileAddress(type: string, name: string): string {
    return `/api/v1/robot-types/${type}/files/${name}`;
  }

  /** Uploads a folder as a preview. `preview` returns its validation result. */
  createPreview(folder: TypeFolder): Promise<TypePreview> {
    return this.#http.call("POST", "/robot-type-previews", { body: { ...folder, wait_ms: 0 }, waitMs: UPLOAD_TIMEOUT_MS });
  }

  preview(id: string): Promise<TypePreview> {
    return this.#http.call("GET", `/robot-type-previews/${id}`);
  }

  previewModel(id: string): Promise<TypeModel> {
    return this.#model(`/robot-type-previews/${id}/twin`);
  }

  savePreview(id: string): Promise<RobotType> {
    const body = { wait_ms: VALIDATION_WAIT_MS };
    return this.#http.call("POST", `/robot-type-previews/${id}/save`, { body, waitMs: VALIDATION_WAIT_MS });
  }

  async deletePreview(id: string): Promise<void> {
    await this.#http.call("DELETE", `/robot-type-previews/${id}`, { keepalive: true });
  }

  async #model(path: string): Promise<TypeModel> {
    const { actuators, cameras, ...twin } = await this.#http.call<TwinResponse>("GET", path);
    // Validate it like a robot's own model: the page draws validated models only.
    return { twin: readTwin(new TextEncoder().encode(JSON.stringify(twin))), actuators, cameras };
  }
}
