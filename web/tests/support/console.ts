/** A device's page on virtual time, with a fake server and link. Importing it creates them before each test of the file. */
import { afterEach, beforeEach, vi } from "vitest";
import { DeviceStore } from "../../src/features/devices/model/device-store";
import { startClock } from "../../src/shared/lib/clock";
import { FakeLink } from "./fake-link";
import { FakeServer } from "./fake-server";
import { CONN, TOPIC, description, listed, telemetry } from "./messages";

export let server: FakeServer;
export let link: FakeLink;
export let device: DeviceStore;
/** Called in reverse order after the test. */
export let ends: (() => void)[];

beforeEach(async () => {
  vi.useFakeTimers();
  server = new FakeServer();
  link = new FakeLink();
  device = new DeviceStore(listed(), server.api, link);
  ends = [startClock(), device.watch(), device.watchDetails()];
  deliver("desc", description);
  await pass(250); // The clock's signal now follows the virtual time.
  deliver("tele/joints", telemetry());
});

afterEach(() => {
  for (const end of ends.reverse()) end();
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

/** Advances the virtual time [ms]. */
export async function pass(ms: number): Promise<void> {
  await vi.advanceTimersByTimeAsync(ms);
}

/** Delivers a message of the device, or of its agent for `conn`. */
export function deliver(kind: string, message: object | string): void {
  link.deliver(kind === "conn" ? CONN : `${TOPIC}/${kind}`, message);
}
