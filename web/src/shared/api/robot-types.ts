/** Robot types over the HTTP API: those that one may see, and one that is looked at before it is saved. */
import type { Http } from "./http";
import { readTwin, type KnownTwin } from "../mqtt/parse-messages";
import type { Joint, MimicJoint, PositionDependentLimit } from "../mqtt/protocol.generated";

export type TypeState = "checking" | "ready" | "rejected";

export interface TypeUpload {
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
  /** What its robots may be asked for; each says itself what it really takes. */
  actions: string[];
  streams: { name: string; rate_hz: number }[];
  built_in: boolean;
  state: TypeState;
  /** Name → bytes. */
  files: Record<string, number>;
  upload: TypeUpload | null;
}

/** A temporary upload for checking. Only its owner sees it; it expires. */
export interface Look {
  id: string;
  expires_at: string;
  robot_type: RobotType;
}

/** The model as the page draws it, and what else is in it. */
export interface TypeModel {
  twin: KnownTwin;
  actuators: string[];
  cameras: string[];
}

export interface TypeMovement {
  name: string;
  description: string;
  version: number;
  built_in: boolean;
}

/** What is sent of a folder: files are text where they are XML, else base64; movements are scripts by name. */
export interface TypeFolder {
  manifest: string;
  files: Record<string, string>;
  movements: Record<string, string>;
}

interface TwinAnswer {
  device: string;
  bodies: unknown;
  actuators: string[];
  cameras: string[];
}

/** How long a large upload may take on a slow line [ms]. */
const SENDING_MS = 170_000;
/** What the server is asked to wait for a verdict on what is saved [ms]. */
const VERDICT_MS = 20_000;

/** All of its methods throw `ApiError`, and nothing else but a `MessageError` where a drawing is not one. */
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

  /** Where all its files are, as one archive. */
  archiveAddress(type: string): string {
    return `/api/v1/robot-types/${type}/archive`;
  }

  fileAddress(type: string, name: string): string {
    return `/api/v1/robot-types/${type}/files/${name}`;
  }

  /** Upload for a look; the verdict is asked for afterwards. */
  look(folder: TypeFolder): Promise<Look> {
    return this.#http.call("POST", "/robot-type-previews", { body: { ...folder, wait_ms: 0 }, waitMs: SENDING_MS });
  }

  lookAgain(id: string): Promise<Look> {
    return this.#http.call("GET", `/robot-type-previews/${id}`);
  }

  lookModel(id: string): Promise<TypeModel> {
    return this.#model(`/robot-type-previews/${id}/twin`);
  }

  save(id: string): Promise<RobotType> {
    const body = { wait_ms: VERDICT_MS };
    return this.#http.call("POST", `/robot-type-previews/${id}/save`, { body, waitMs: VERDICT_MS });
  }

  async drop(id: string): Promise<void> {
    await this.#http.call("DELETE", `/robot-type-previews/${id}`, { keepalive: true });
  }

  async #model(path: string): Promise<TypeModel> {
    const { actuators, cameras, ...twin } = await this.#http.call<TwinAnswer>("GET", path);
    // Read as what a robot says of itself is: a page draws nothing that has not been looked at.
    return { twin: readTwin(new TextEncoder().encode(JSON.stringify(twin))), actuators, cameras };
  }
}
