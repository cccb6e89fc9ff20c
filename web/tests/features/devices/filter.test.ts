import { signal } from "@preact/signals-core";
import { expect, it } from "vitest";
import type { DeviceStore } from "../../../src/features/devices/model/device-store";
import { matchesFilter, type DeviceFilter } from "../../../src/features/devices/model/filter";
import type { Device } from "../../../src/shared/api/types";
import { listed } from "../../support/messages";

const ALL: DeviceFilter = { search: "", kinds: "all", owner: "all", needsAttention: false };
const LAMP = { kind: "lamp", robot_type: "lamp" };

it.each<[expected: boolean, filter: Partial<DeviceFilter>, info: Partial<Device>, reach: string, faults: number]>([
  [true, { search: "two UR5 window" }, {}, "online", 0],
  [false, { search: "two nao" }, {}, "online", 0],
  [true, { kinds: "sensors" }, LAMP, "online", 0],
  [false, { kinds: "robots" }, LAMP, "online", 0],
  [true, { owner: "shared" }, { role: "operator" }, "online", 0],
  [false, { owner: "mine" }, { role: "operator" }, "online", 0],
  [true, { owner: "mine" }, {}, "online", 0],
  [false, { needsAttention: true }, {}, "online", 0],
  [true, { needsAttention: true }, {}, "online", 1],
  [true, { needsAttention: true }, {}, "stale", 0],
])("%s: the filter %o matches a device with %o, %s, %i faults", (expected, filter, info, reach, faults) => {
  const device = { info: signal(listed({ label: "Arm at the window", ...info })), reach: signal(reach), stopped: signal(false), state: signal(null) };
  expect(matchesFilter(device as unknown as DeviceStore, "Lab two", faults, { ...ALL, ...filter })).toBe(expected);
});
