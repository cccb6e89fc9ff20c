import { MessageError } from "../../src/shared/mqtt/checks";
import { describe, expect, it } from "vitest";
import { readAck, readDescription, readPresence, readState, readTelemetry, readTwin } from "../../src/shared/mqtt/parse-messages";
import { description, twin } from "../support/arm";

const bytes = (value: unknown): Uint8Array => new TextEncoder().encode(typeof value === "string" ? value : JSON.stringify(value));

const telemetry = {
  tick_ms: 1,
  at_ms: 2,
  sequence: 3,
  mode: "idle",
  position_rad: [0, 1],
  velocity_rad_s: [0, 0],
  effort_nm: [0, 0],
  commanded_rad: [0, 1],
};

describe("messages from a robot", () => {
  it("are read with what they leave out filled in", () => {
    expect(readTelemetry(bytes(telemetry))).toMatchObject({ frames: [], epoch: 0, setpoint_sequence: 0, limited: [] });
    expect(readPresence(bytes({ online: true, session: 4, at_ms: 5 }))).toEqual({ online: true, session: 4, at_ms: 5, software: "" });
    expect(readState(bytes({ device: "arm", at_ms: 1, tick_ms: 1, mode: "idle", epoch: 0 })).stop).toBeNull();
  });

  it("of a newer version keep what this page knows", () => {
    expect(readPresence(bytes({ online: false, session: 1, at_ms: 1, mood: "good" }))).not.toHaveProperty("mood");
  });

  it("of the real UR5 pass", () => {
    expect(readDescription(bytes(description)).joints).toHaveLength(6);
    expect(readTwin(bytes(twin)).bodies.length).toBeGreaterThan(6);
  });

  it.each([
    ["an infinity", `{"tick_ms":1,"at_ms":2,"sequence":3,"mode":"idle","position_rad":[1e999],"velocity_rad_s":[0],"effort_nm":[0],"commanded_rad":[0]}`],
    ["a NaN", `{"tick_ms":1,"at_ms":2,"sequence":3,"mode":"idle","position_rad":[NaN],"velocity_rad_s":[0],"effort_nm":[0],"commanded_rad":[0]}`],
    ["a null among numbers", { ...telemetry, position_rad: [0, null] }],
    ["lists of different lengths", { ...telemetry, velocity_rad_s: [0] }],
    ["an unknown mode", { ...telemetry, mode: "dancing" }],
    ["a pose of six numbers", { ...telemetry, frames: [[0, 0, 0, 1, 0, 0]] }],
    ["text where a number belongs", { ...telemetry, tick_ms: "1" }],
    ["a negative count", { ...telemetry, sequence: -1 }],
    ["a list at the top", []],
    ["no JSON", "{"],
    ["too many joints", { ...telemetry, position_rad: Array.from({ length: 129 }, () => 0) }],
  ])("are refused with %s", (_, message) => {
    expect(() => readTelemetry(bytes(message))).toThrow(MessageError);
  });

  it("are refused when not UTF-8 or too long", () => {
    expect(() => readAck(Uint8Array.of(0x22, 0xff, 0x22))).toThrow(MessageError);
    expect(() => readAck(bytes(`"${"x".repeat(128 * 1024)}"`))).toThrow(/longer/);
  });

  it("name the field that is wrong", () => {
    const broken = { ...description, joints: [{ ...description.joints[0], upper_rad: null }] };
    expect(() => readDescription(bytes(broken))).toThrow("desc.joints[0].upper_rad is not a finite number");
  });

  it("are refused when a joint's range is none, or two joints share a name", () => {
    const [joint] = description.joints;
    expect(() => readDescription(bytes({ ...description, joints: [{ ...joint, lower_rad: 9 }] }))).toThrow(/range/);
    expect(() => readDescription(bytes({ ...description, joints: [joint, joint] }))).toThrow(/distinct/);
  });

  it.each([
    ["comes later", 1],
    ["is itself", 0],
    ["is not there", 7],
    ["is no index", 0.5],
  ])("are refused when a body's parent %s", (_, parent) => {
    const body = { name: "a", parent, position_m: [0, 0, 0], quaternion: [1, 0, 0, 0] };
    expect(() => readTwin(bytes({ device: "arm", bodies: [body] }))).toThrow(/earlier body/);
  });
});
