/** The lease's life on a clock that the test turns, with the server's answers in the test's hands. */
import type { Device, GrantedLease, Lease } from "../../../src/shared/api/types";
import { signal } from "@preact/signals-core";
import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { Api } from "../../../src/shared/api/client";
import { ApiError } from "../../../src/shared/api/http";
import { Control, LEASE_MS } from "../../../src/features/control/model/lease";
import { DeviceStore } from "../../../src/features/devices/model/device-store";
import type { Link, LinkStatus, Receiver } from "../../../src/shared/mqtt/mqtt-link";
import { description } from "../../support/arm";

const TOPIC = "ts/v1/lab/a1/arm";

class Wire implements Link {
  readonly status = signal<LinkStatus>({ state: "up", why: "" });
  readonly up = signal(true);
  readonly receivers = new Map<string, Receiver>();
  readonly published: { topic: string; message: object }[] = [];
  closed = false;

  subscribe(filter: string, receiver: Receiver): () => void {
    this.receivers.set(filter, receiver);
    return () => this.receivers.delete(filter);
  }

  publish(topic: string, message: object): Promise<void> {
    this.published.push({ topic, message });
    return Promise.resolve();
  }

  ping(): Promise<void> {
    return Promise.resolve();
  }

  renew(): void {
    throw new Error("unexpected call");
  }

  close(): void {
    this.closed = true;
  }

  tell(kind: string, message: object): void {
    const filter = kind === "tele/joints" ? `${TOPIC}/tele/+` : `${TOPIC}/${kind}`;
    this.receivers.get(filter)?.(`${TOPIC}/${kind}`, new TextEncoder().encode(JSON.stringify(message)), false);
  }
}

/** Answers renewals as the test says. */
class Desk extends Api {
  renewals = 0;
  released: number[] = [];
  renewal: () => Promise<GrantedLease> = () => Promise.resolve(grant(5));
  taking: () => Promise<GrantedLease> = () => Promise.resolve(grant(5));

  override takeLease(): Promise<GrantedLease> {
    return this.taking();
  }

  override renewLease(): Promise<GrantedLease> {
    this.renewals += 1;
    return this.renewal();
  }

  override releaseLease(_: string, epoch: number): Promise<void> {
    this.released.push(epoch);
    return Promise.resolve();
  }

  override lease(): Promise<Lease | null> {
    return Promise.resolve(null);
  }
}

function grant(epoch: number): GrantedLease {
  return { epoch, holder: "Demo", expires_at: "2030-01-01T00:00:00.000Z", lease_ms: LEASE_MS, confirmed: true };
}

const info: Device = {
  id: "a1-arm",
  name: "arm",
  label: "Arm",
  kind: "arm",
  robot_type: "ur5",
  agent: "a1",
  space: "lab",
  role: "owner",
  owner: { id: "account0001", name: "Ann" },
  topic: TOPIC,
  online: true,
  last_seen_at: null,
  lease: null,
};

let tick = 0;
function telemetry(rest: object = {}): object {
  tick += 50;
  const zeros = description.joints.map(() => 0);
  return {
    tick_ms: tick,
    at_ms: tick,
    sequence: tick,
    mode: "holding",
    position_rad: zeros,
    velocity_rad_s: zeros,
    effort_nm: zeros,
    commanded_rad: zeros,
    epoch: 5,
    ...rest,
  };
}

let watch: Wire;
let wire: Wire;
let desk: Desk;
let device: DeviceStore;
let control: Control;

beforeEach(() => {
  vi.useFakeTimers();
  watch = new Wire();
  wire = new Wire();
  desk = new Desk();
  device = new DeviceStore(info, desk, watch);
  device.watch();
  device.watchClosely();
  watch.tell("desc", description);
  watch.tell("tele/joints", telemetry());
  control = new Control(desk, device, () => wire);
});

afterEach(() => {
  control.dispose();
  vi.useRealTimers();
});

describe("control of a device", () => {
  it("is renewed every third of the lease, for as long as it is held", async () => {
    await control.take();
    expect(control.state.value).toEqual({ kind: "held", epoch: 5, confirmed: true });
    await vi.advanceTimersByTimeAsync(LEASE_MS * 3 + 100);
    expect(desk.renewals).toBe(9);
    expect(control.epoch).toBe(5);
  });

  it("is lost at once when the server says so, and streams nothing more", async () => {
    await control.take();
    // A robot on its way, so that the stream has every reason to go on.
    const talk = setInterval(() => watch.tell("tele/joints", telemetry({ velocity_rad_s: [0, 0, 1, 0, 0, 0] })), 50);
    await vi.advanceTimersByTimeAsync(LEASE_MS / 3 - 500);
    control.streamer.value?.setTarget("elbow", 1);
    await vi.advanceTimersByTimeAsync(400);
    expect(wire.published.length).toBeGreaterThan(10);
    desk.renewal = () => Promise.reject(new ApiError(409, "lease-lost", "Ann has control."));
    await vi.advanceTimersByTimeAsync(110);
    expect(control.state.value).toEqual({ kind: "lost", why: "Ann has control." });
    expect(control.streamer.value).toBeNull();
    expect(wire.closed).toBe(true);
    const sent = wire.published.length;
    await vi.advanceTimersByTimeAsync(1_000);
    expect(wire.published).toHaveLength(sent);
    clearInterval(talk);
  });

  it("survives a server that is away for a moment", async () => {
    await control.take();
    desk.renewal = () => Promise.reject(new ApiError(0, "unreachable", "The server cannot be reached."));
    await vi.advanceTimersByTimeAsync(LEASE_MS / 2);
    expect(control.epoch).toBe(5);
    expect(desk.renewals).toBeGreaterThan(3);
    desk.renewal = () => Promise.resolve(grant(5));
    await vi.advanceTimersByTimeAsync(LEASE_MS * 2);
    expect(control.epoch).toBe(5);
  });

  it("ends when it could not be renewed in time, even while a call hangs", async () => {
    await control.take();
    desk.renewal = () => new Promise(() => undefined);
    await vi.advanceTimersByTimeAsync(LEASE_MS + 10);
    expect(control.state.value.kind).toBe("lost");
  });

  it.each([
    ["telemetry", "tele/joints", telemetry({ epoch: 6 })],
    ["state", "state", { device: "arm", at_ms: 1, tick_ms: 1, mode: "holding", epoch: 6 }],
  ])("is lost at once when the robot's %s names a newer lease", async (_, kind, message) => {
    await control.take();
    watch.tell(kind, { ...message, ...(kind === "tele/joints" ? { tick_ms: (tick += 50), at_ms: tick } : {}) });
    await vi.advanceTimersByTimeAsync(1);
    expect(control.state.value).toMatchObject({ kind: "lost" });
  });

  it("is lost when the robot has ended it by itself, and is left to others", async () => {
    await control.take();
    watch.tell("tele/joints", telemetry({ epoch: 5 }));
    await vi.advanceTimersByTimeAsync(1);
    expect(control.epoch).toBe(5);
    watch.tell("tele/joints", telemetry({ epoch: 0, mode: "holding" }));
    await vi.advanceTimersByTimeAsync(1);
    expect(control.state.value).toMatchObject({ kind: "lost" });
    expect(wire.closed).toBe(true);
    expect(desk.released).toEqual([5]);
  });

  it("does not take a lease that another operator holds, and names that operator", async () => {
    desk.taking = () => Promise.reject(new ApiError(409, "lease-held", "Ann has control."));
    await control.take();
    expect(control.state.value).toEqual({ kind: "refused", why: "Ann has control." });
    expect(control.epoch).toBeNull();
  });

  it("is given back with the epoch it has", async () => {
    await control.take();
    await control.release();
    expect(desk.released).toEqual([5]);
    expect(control.state.value).toEqual({ kind: "none" });
    expect(wire.closed).toBe(true);
    await vi.advanceTimersByTimeAsync(LEASE_MS);
    expect(desk.renewals).toBe(0);
  });

  it("is confirmed by the robot's own word where the cloud could not say", async () => {
    desk.taking = () => Promise.resolve({ ...grant(5), confirmed: false });
    watch.tell("tele/joints", telemetry({ epoch: 4 }));
    await control.take();
    expect(control.state.value).toMatchObject({ kind: "held", confirmed: false });
    watch.tell("tele/joints", telemetry({ epoch: 5 }));
    await vi.advanceTimersByTimeAsync(1);
    expect(control.state.value).toMatchObject({ kind: "held", confirmed: true });
  });

  it("sends setpoints to the lease's own topic, and measures the round trip on this page's clock", async () => {
    await control.take();
    control.streamer.value?.setTarget("elbow", 1);
    const [first] = wire.published;
    expect(first?.topic).toBe(`${TOPIC}/ctl/5`);
    const sent = first?.message as { sent_ms: number; sequence: number };
    await vi.advanceTimersByTimeAsync(30);
    watch.tell("tele/joints", telemetry({ setpoint_sequence: sent.sequence, setpoint_sent_ms: sent.sent_ms }));
    await vi.advanceTimersByTimeAsync(1);
    expect(control.roundTrip.figures.value).toMatchObject({ latestMs: 30, samples: 1 });
  });
});
