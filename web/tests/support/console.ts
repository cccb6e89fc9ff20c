/** A console on a WebSocket broker with a simulated arm. Importing it starts both before each test of the file. */
import { afterEach, beforeEach } from "vitest";
import { Api } from "../../src/shared/api/client";
import { startClock } from "../../src/shared/lib/clock";
import { Fleet } from "../../src/features/devices/model/device-list";
import type { DeviceStore } from "../../src/features/devices/model/device-store";
import { Cloud, DEVICE } from "./cloud";
import { until } from "./until";

export const TOPIC = "ts/v1/lab/agent00001/arm";

export let cloud: Cloud;
export let api: Api;
export let fleet: Fleet;
export let device: DeviceStore;
export let ends: (() => void)[];

beforeEach(async () => {
  cloud = new Cloud();
  await cloud.start();
  api = new Api(`${cloud.address}/api/v1`);
  await api.me();
  fleet = new Fleet(api);
  ends = [startClock(), () => fleet.dispose()];
  await until(() => fleet.devices.value?.has(DEVICE) === true, "the list");
  const listed = fleet.devices.value?.get(DEVICE);
  if (listed === undefined) throw new Error("no device");
  device = listed;
  ends.push(device.watchClosely());
  await until(() => device.reach.value === "online" && device.description.value !== null, "the device");
});

afterEach(async () => {
  for (const end of ends.reverse()) end();
  await cloud.stop();
});

export function arm(): NonNullable<Cloud["arm"]> {
  if (cloud.arm === null) throw new Error("no arm");
  return cloud.arm;
}
