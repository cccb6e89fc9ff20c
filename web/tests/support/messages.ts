/** One arm, its entry in the device list and its messages. */
import type { Device } from "../../src/shared/api/types";
import type { Description, Twin } from "../../src/shared/mqtt/protocol.generated";
import fixture from "../fixtures/ur5.json";

export const description = fixture.description as unknown as Required<Description>;
export const twin = fixture.twin as unknown as Twin;

export const DEVICE = "a1-arm";
export const CONN = "ts/v1/lab/a1/conn";
export const TOPIC = "ts/v1/lab/a1/arm";

export const bytes = (value: unknown): Uint8Array => new TextEncoder().encode(typeof value === "string" ? value : JSON.stringify(value));

export function listed(part: Partial<Device> = {}): Device {
  return {
    id: DEVICE, name: "arm", label: "Arm", kind: "arm", robot_type: "ur5", agent: "a1", space: "lab", role: "owner",
    owner: { id: "account0001", name: "Ann" }, topic: TOPIC, online: true, incompatible: null, last_seen_at: null, lease: null,
    setpoints_over: ["mqtt"], ...part,
  };
}

let tick = 0;

/** Each message is later than the previous one. */
export function telemetry(rest: object = {}): object {
  tick += 50;
  const zeros = description.joints.map(() => 0);
  const lists = { position_rad: zeros, velocity_rad_s: zeros, effort_nm: zeros, commanded_rad: zeros };
  return { tick_ms: tick, at_ms: tick, sequence: tick, mode: "holding", ...lists, epoch: 5, ...rest };
}

export function state(epoch: number, holder: string | null = null, rest: object = {}): object {
  const lease = holder === null ? null : { holder, epoch, expires_in_ms: 30_000, reason: "", request: null };
  tick += 50;
  return { device: "arm", at_ms: Date.now(), tick_ms: tick, mode: "holding", epoch, lease, ...rest };
}
