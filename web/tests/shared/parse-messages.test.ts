import { describe, expect, it } from "vitest";
import { MessageError } from "../../src/shared/mqtt/checks";
import { readAck, readDescription, readPresence, readState, readTelemetry, readTwin } from "../../src/shared/mqtt/parse-messages";
import { bytes, description, state, telemetry, twin } from "../support/messages";

describe("messages from a robot", () => {
  it("are read with defaults for absent fields and without unknown fields", () => {
    expect(readTelemetry(bytes(telemetry({ epoch: undefined })))).toMatchObject({ frames: [], epoch: 0, setpoint_sequence: 0, limited: [] });
    expect(readPresence(bytes({ online: true, session: 4, at_ms: 5, mood: "good" }))).toEqual({
      online: true, session: 4, at_ms: 5, software: "", protocol: { min: 1, max: 1 }, capabilities: [],
    });
    expect(readState(bytes(state(0))).stop).toBeNull();
    expect(readDescription(bytes(description)).joints).toHaveLength(6);
    expect(readTwin(bytes(twin)).bodies.length).toBeGreaterThan(6);
  });

  const text = JSON.stringify(telemetry({ position_rad: [0] }));
  it.each([
    ["an infinity", text.replace('"position_rad":[0]', '"position_rad":[1e999]')],
    ["a NaN", text.replace('"position_rad":[0]', '"position_rad":[NaN]')],
    ["a null among numbers", telemetry({ position_rad: [0, 0, 0, 0, 0, null] })],
    ["lists of different lengths", telemetry({ velocity_rad_s: [0] })],
    ["an unknown mode", telemetry({ mode: "dancing" })],
    ["a pose of six numbers", telemetry({ frames: [[0, 0, 0, 1, 0, 0]] })],
    ["text instead of a number", telemetry({ tick_ms: "1" })],
    ["a negative count", telemetry({ sequence: -1 })],
    ["a list at the top", []],
    ["invalid JSON", "{"],
    ["too many joints", telemetry({ position_rad: Array(129).fill(0) })],
  ])("are rejected with %s", (_, message) => {
    expect(() => readTelemetry(bytes(message))).toThrow(MessageError);
  });

  it("are rejected when they are not UTF-8 or too long", () => {
    expect(() => readAck(Uint8Array.of(0x22, 0xff, 0x22))).toThrow(MessageError);
    expect(() => readAck(bytes(`"${"x".repeat(128 * 1024)}"`))).toThrow(/longer/);
  });

  const [joint] = description.joints;
  it.each([
    ["no finite limit", [{ ...joint, upper_rad: null }], "desc.joints[0].upper_rad is not a finite number"],
    ["an empty range", [{ ...joint, lower_rad: 9 }], "range"],
    ["the same name twice", [joint, joint], "distinct"],
  ])("are rejected when joints have %s; the error names the field", (_, joints, message) => {
    expect(() => readDescription(bytes({ ...description, joints }))).toThrow(message);
  });

  it.each([1, 0, 7, 0.5])("are rejected when the first body's parent is %s", (parent) => {
    const body = { name: "a", parent, position_m: [0, 0, 0], quaternion: [1, 0, 0, 0] };
    expect(() => readTwin(bytes({ device: "arm", bodies: [body] }))).toThrow(/earlier body/);
  });
});
