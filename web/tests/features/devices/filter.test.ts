import type { Device } from "../../../src/shared/api/types";
import { signal } from "@preact/signals-core";
import { describe, expect, it } from "vitest";
import type { DeviceStore } from "../../../src/features/devices/model/device-store";
import { matchesFilter, type DeviceFilter } from "../../../src/features/devices/model/filter";

const ALL: DeviceFilter = { search: "", kinds: "all", whose: "all", onlyTrouble: false };

function device(info: Partial<Device>, reach = "online"): DeviceStore {
  const whole = { label: "Arm at the window", name: "arm", kind: "arm", robot_type: "ur5", role: "owner", ...info };
  return { info: signal(whole), reach: signal(reach), stopped: signal(false), state: signal(null) } as unknown as DeviceStore;
}

describe("a list of devices", () => {
  it("finds by words anywhere in label, name, type, kind or room, in any order", () => {
    expect(matchesFilter(device({}), "Lab two", 0, { ...ALL, search: "two UR5 window" })).toBe(true);
    expect(matchesFilter(device({}), "Lab two", 0, { ...ALL, search: "two nao" })).toBe(false);
  });

  it("tells robots from what hangs in a room", () => {
    const lamp = device({ kind: "lamp", robot_type: "lamp" });
    expect(matchesFilter(lamp, "Lab", 0, { ...ALL, kinds: "sensors" })).toBe(true);
    expect(matchesFilter(lamp, "Lab", 0, { ...ALL, kinds: "robots" })).toBe(false);
  });

  it("tells one's own from what others share", () => {
    const shared = device({ role: "operator" });
    expect(matchesFilter(shared, "Lab", 0, { ...ALL, whose: "shared" })).toBe(true);
    expect(matchesFilter(shared, "Lab", 0, { ...ALL, whose: "mine" })).toBe(false);
    expect(matchesFilter(device({}), "Lab", 0, { ...ALL, whose: "mine" })).toBe(true);
  });

  it("keeps what needs a look: by a fault, or because it is offline", () => {
    expect(matchesFilter(device({}), "Lab", 0, { ...ALL, onlyTrouble: true })).toBe(false);
    expect(matchesFilter(device({}), "Lab", 1, { ...ALL, onlyTrouble: true })).toBe(true);
    expect(matchesFilter(device({}, "stale"), "Lab", 0, { ...ALL, onlyTrouble: true })).toBe(true);
  });
});
