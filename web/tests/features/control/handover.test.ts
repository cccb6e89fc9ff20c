/** Control from hand to hand, as each of the two pages lives it, with the server's answers in the test's hands. */
import type { ControlRequestInfo, Device, GrantedLease, Lease, Watcher } from "../../../src/shared/api/types";
import { signal } from "@preact/signals-core";
import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { Api } from "../../../src/shared/api/client";
import { Control, LEASE_MS } from "../../../src/features/control/model/lease";
import { DeviceStore } from "../../../src/features/devices/model/device-store";
import { ApiError } from "../../../src/shared/api/http";
import type { Link, LinkStatus, Receiver } from "../../../src/shared/mqtt/mqtt-link";
import { Watchers } from "../../../src/features/control/model/watchers";
import { description } from "../../support/arm";

const TOPIC = "ts/v1/lab/a1/arm";

class Wire implements Link {
  readonly status = signal<LinkStatus>({ state: "up", why: "" });
  readonly up = signal(true);
  readonly receivers = new Map<string, Receiver>();

  subscribe(filter: string, receiver: Receiver): () => void {
    this.receivers.set(filter, receiver);
    return () => this.receivers.delete(filter);
  }

  publish(): Promise<void> {
    return Promise.resolve();
  }

  ping(): Promise<never> {
    return Promise.reject(new Error("unexpected call"));
  }

  renew(): void {
    throw new Error("unexpected call");
  }

  close(): void {
    this.status.value = { state: "closed", why: "" };
  }

  tell(kind: string, message: object): void {
    const payload = new TextEncoder().encode(JSON.stringify(message));
    this.receivers.get(`${TOPIC}/${kind}`)?.(`${TOPIC}/${kind}`, payload, false);
  }
}

const opened = (outcome: ControlRequestInfo["outcome"] = "open"): ControlRequestInfo => ({
  id: "r1",
  requester: "Bob",
  epoch: 5,
  mine: true,
  requested_at: new Date(Date.now()).toISOString(),
  expires_at: new Date(Date.now() + 30_000).toISOString(),
  outcome,
});

class Desk extends Api {
  outcome: ControlRequestInfo["outcome"] = "open";
  /** Answers what is asked about a request in the place of `outcome`. */
  trouble: ApiError | null = null;
  readonly calls: string[] = [];
  current: Lease | null = null;
  taken: string[] = [];

  override takeLease(): Promise<GrantedLease> {
    return Promise.resolve(grant(5));
  }

  override renewLease(_: string, __: number, epoch: number): Promise<GrantedLease> {
    this.calls.push(`renew ${epoch}`);
    return Promise.resolve(grant(epoch));
  }

  override takeOver(_: string, __: number, reason: string): Promise<GrantedLease> {
    this.calls.push(`over ${reason}`);
    return Promise.resolve(grant(6));
  }

  override releaseLease(_: string, epoch: number): Promise<void> {
    this.calls.push(`release ${epoch}`);
    return Promise.resolve();
  }

  override lease(): Promise<Lease | null> {
    return Promise.resolve(this.current);
  }

  override requestControl(): Promise<{ request: ControlRequestInfo; confirmed: boolean }> {
    if (this.trouble !== null) return Promise.reject(this.trouble);
    return Promise.resolve({ request: opened(), confirmed: true });
  }

  override controlRequest(): Promise<ControlRequestInfo> {
    return this.trouble === null ? Promise.resolve(opened(this.outcome)) : Promise.reject(this.trouble);
  }

  override withdrawRequest(_: string, id: string): Promise<void> {
    this.calls.push(`withdraw ${id}`);
    return this.outcome === "accepted" ? Promise.reject(new ApiError(409, "control-request-closed", "Accepted.")) : Promise.resolve();
  }

  override answerRequest(_: string, id: string, accept: boolean): Promise<void> {
    this.calls.push(`${accept ? "accept" : "refuse"} ${id}`);
    return this.trouble === null ? Promise.resolve() : Promise.reject(this.trouble);
  }
}

function grant(epoch: number): GrantedLease {
  return { epoch, holder: "Ann", expires_at: "2030-01-01T00:00:00.000Z", lease_ms: LEASE_MS, confirmed: true };
}

function state(epoch: number, holder: string | null, request: object | null = null): object {
  const lease = holder === null ? null : { holder, epoch, expires_in_ms: 30_000, reason: "", request };
  return { device: "arm", at_ms: Date.now(), tick_ms: 1, mode: "holding", epoch, lease };
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

let watch: Wire;
let desk: Desk;
let device: DeviceStore;
let control: Control;

beforeEach(() => {
  vi.useFakeTimers();
  watch = new Wire();
  desk = new Desk();
  device = new DeviceStore(info, desk, watch);
  device.watch();
  device.watchClosely();
  watch.tell("desc", description);
  control = new Control(desk, device, () => new Wire());
});

afterEach(() => {
  control.dispose();
  vi.useRealTimers();
});

describe("who asks for control", () => {
  beforeEach(() => device.setLease({ holder: "Ann", epoch: 5, expires_at: "2030-01-01T00:00:00.000Z", mine: false }));

  it("has it by itself once it was handed over, in the epoch that is theirs", async () => {
    await control.asking.ask();
    expect(control.asking.state.value).toMatchObject({ kind: "open", id: "r1", shown: true, of: "Ann" });
    await vi.advanceTimersByTimeAsync(2_000);
    expect(control.epoch).toBeNull();
    desk.outcome = "accepted";
    await vi.advanceTimersByTimeAsync(1_000);
    expect(control.epoch).toBe(6);
    expect(desk.calls).toContain("renew 6");
    expect(control.asking.state.value).toEqual({ kind: "over", how: "accepted", of: "Ann" });
  });

  it("hears of the answer with the word of the device, before the next look", async () => {
    watch.tell("state", state(5, "Ann", { id: "r1", requester: "Bob", expires_in_ms: 30_000 }));
    await control.asking.ask();
    desk.outcome = "accepted";
    watch.tell("state", state(6, "Bob"));
    await vi.advanceTimersByTimeAsync(10);
    expect(control.epoch).toBe(6);
  });

  it.each(["rejected", "expired", "ended"] as const)("reports that the request was %s, and sends no motion", async (how) => {
    await control.asking.ask();
    desk.outcome = how;
    await vi.advanceTimersByTimeAsync(1_000);
    expect(control.asking.state.value).toEqual({ kind: "over", how, of: "Ann" });
    expect(control.state.value).toEqual({ kind: "none" });
    control.read();
    expect(control.asking.state.value).toEqual({ kind: "none" });
  });

  it("asks no longer when they say so, unless it was accepted in the same moment", async () => {
    await control.asking.ask();
    await control.asking.withdraw();
    expect(control.asking.state.value).toMatchObject({ kind: "over", how: "withdrawn" });
    await control.asking.ask();
    desk.outcome = "accepted";
    await control.asking.withdraw();
    await vi.advanceTimersByTimeAsync(10);
    expect(control.epoch).toBe(6);
  });

  it("waits on while the server is away, and no longer than the answer could come", async () => {
    await control.asking.ask();
    desk.trouble = new ApiError(0, "unreachable", "The server cannot be reached.");
    await vi.advanceTimersByTimeAsync(29_000);
    expect(control.asking.state.value.kind).toBe("open");
    await vi.advanceTimersByTimeAsync(8_000);
    expect(control.asking.state.value).toMatchObject({ kind: "over", how: "expired" });
  });

  it("reports why the request failed", async () => {
    desk.trouble = new ApiError(409, "lease-requested", "Eve asks already.");
    await control.asking.ask();
    expect(control.asking.state.value).toEqual({ kind: "failed", why: "Eve asks already." });
  });

  it("leaves no question behind when the page goes away", async () => {
    await control.asking.ask();
    control.dispose();
    expect(desk.calls).toEqual(["withdraw r1"]);
    await vi.advanceTimersByTimeAsync(5_000);
    expect(control.epoch).toBeNull();
  });

  it("takes over with a reason, where they may", async () => {
    await control.takeOver("the arm is needed");
    expect(control.epoch).toBe(6);
    expect(desk.calls).toEqual(["over the arm is needed"]);
  });
});

describe("who has control", () => {
  beforeEach(async () => {
    await control.take();
    watch.tell("state", state(5, "Ann", { id: "r1", requester: "Bob", expires_in_ms: 20_000 }));
  });

  it("sees who asks, and for how long still", () => {
    const asked = control.asked.value;
    expect(asked).toMatchObject({ id: "r1", by: "Bob" });
    expect((asked?.until ?? 0) - performance.now()).toBeCloseTo(20_000, -2);
    watch.tell("state", state(5, "Ann"));
    expect(control.asked.value).toBeNull();
  });

  it("sees it by the word of the cloud where the device has not said it", () => {
    watch.tell("state", state(4, "Ann"));
    device.setLease({ holder: "Ann", epoch: 5, expires_at: "2030-01-01T00:00:00.000Z", mine: true, request: opened() });
    expect(control.asked.value).toMatchObject({ id: "r1", by: "Bob" });
  });

  it("hands it over and has nothing left to move with, and gives nothing back that is another's", async () => {
    await control.answer(true);
    expect(control.state.value).toEqual({ kind: "handed", to: "Bob" });
    expect(control.streamer.value).toBeNull();
    expect(desk.calls).toEqual(["accept r1"]);
  });

  it("has handed it over also where the robot says so before the server answers", async () => {
    const answered = control.answer(true);
    watch.tell("state", state(6, "Bob"));
    await vi.advanceTimersByTimeAsync(0);
    expect(control.state.value).toEqual({ kind: "handed", to: "Bob" });
    await answered;
    expect(control.state.value).toEqual({ kind: "handed", to: "Bob" });
  });

  it("keeps it", async () => {
    await control.answer(false);
    expect(control.epoch).toBe(5);
    expect(control.answered.value).toEqual({ kind: "kept", from: "Bob" });
  });

  it("keeps control and reports a response that was too late", async () => {
    desk.trouble = new ApiError(409, "control-request-closed", "It was not answered in time.");
    await control.answer(true);
    expect(control.epoch).toBe(5);
    expect(control.answered.value).toEqual({ kind: "failed", why: "It was not answered in time." });
  });
});

describe("who else watches", () => {
  const bob: Watcher = { name: "Bob", role: "viewer", mine: false, since: "2026-01-01T00:00:00.000Z" };

  it("is asked for as long as the page is seen, and said to be over when it is not", async () => {
    const said: string[] = [];
    let away = false;
    class Door extends Api {
      override watch(): Promise<{ items: Watcher[]; refresh_ms: number }> {
        said.push("look");
        return away ? Promise.reject(new ApiError(0, "unreachable", "No.")) : Promise.resolve({ items: [bob], refresh_ms: 10_000 });
      }
      override unwatch(): Promise<void> {
        said.push("leave");
        return Promise.resolve();
      }
    }
    const watching = new Watchers(new Door(), "a1-arm");
    watching.seen(true);
    watching.seen(true);
    await vi.advanceTimersByTimeAsync(25_000);
    expect(said).toEqual(["look", "look", "look"]);
    expect(watching.others.value).toEqual([bob]);
    away = true;
    await vi.advanceTimersByTimeAsync(10_000);
    expect(watching.others.value).toBeNull(); // what is not known is not shown
    watching.seen(false);
    await vi.advanceTimersByTimeAsync(60_000);
    expect(said).toEqual(["look", "look", "look", "look", "leave"]);
  });
});
