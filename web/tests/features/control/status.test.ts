import { signal } from "@preact/signals-core";
import { describe, expect, it } from "vitest";
import type { Run, RunStatus } from "../../../src/features/actions/model";
import type { DeviceSession } from "../../../src/features/control/model";
import { availability, ownAction, reportedEnd } from "../../../src/features/control/model/status";
import { deliver, device, pass } from "../../support/console";
import { DEVICE, state, telemetry } from "../../support/messages";

const WAVE = { id: "action1", kind: "run_movement", name: "wave", progress: 0 };

/** The session of account "ann-id" with one run of this page. */
function session(status: RunStatus | null = null): DeviceSession {
  const runs: Partial<Run>[] = status === null ? [] : [{ id: "action1", status, request: { kind: "run_movement", name: "wave" } }];
  return { device, account: "ann-id", actions: { runs: signal(runs) } } as unknown as DeviceSession;
}

function lease(account: string, mine: boolean): void {
  device.setLease({ holder: "Ann", holder_account: account, epoch: 7, expires_at: "2030-01-01T00:00:00.000Z", mine });
}

describe("the own action", () => {
  it("is the run of this page, before the robot reports it", () => {
    expect(ownAction(session("started"))).toEqual({ name: "wave", elsewhere: false });
    expect(ownAction(session("sent"))).toBeNull();
    expect(ownAction(session("done"))).toBeNull();
    expect(ownAction(session())).toBeNull();
  });

  it("is also that of another tab of this session, and of another session of this account", async () => {
    deliver("state", state(7, "Ann", { action: WAVE }));
    await pass(1);
    lease("ann-id", true);
    expect(ownAction(session())).toEqual({ name: "wave", elsewhere: false });
    lease("ann-id", false);
    expect(ownAction(session())).toEqual({ name: "wave", elsewhere: true });
  });

  it("is not that of another account, nor one that has ended", async () => {
    deliver("state", state(7, "Ann", { action: WAVE }));
    await pass(1);
    lease("bob-id", false);
    expect(ownAction(session())).toBeNull();
    lease("ann-id", true);
    expect(ownAction(session("done"))).toBeNull();
  });

  it("without a name is called by its kind", async () => {
    deliver("state", state(7, "Ann", { action: { ...WAVE, kind: "move_joints", name: "" } }));
    await pass(1);
    lease("ann-id", true);
    expect(ownAction(session())?.name).toBe("move joints");
  });
});

describe("control of a device without an operator", () => {
  async function shown(mode: string, rest: object = {}): Promise<string> {
    deliver("tele/joints", telemetry({ mode }));
    deliver("state", state(5, null, { mode, faults: [], ...rest }));
    await pass(1);
    return availability(device);
  }

  it("is available only while its state is current, without Stop and without a fault", async () => {
    expect(await shown("holding")).toBe("available");
    expect(await shown("fault")).toBe("fault");
    const stop = { caller: "Ann", reason: "", at_ms: 1, verified: true };
    expect(await shown("fault", { stop })).toBe("stop");
    expect(await shown("stopped", { stop })).toBe("stop");
    expect(await shown("holding")).toBe("available");
    await pass(1_000);
    expect(availability(device)).toBe("unknown");
  });
});

describe("the end of a lease", () => {
  const event = (epoch: number, code: string, why: string): object => ({
    id: `e${epoch}`, device: DEVICE, at_ms: 1, kind: "lease-ended", severity: "info", message: `Ann's control ended: ${why}`, data: { epoch, holder: "Ann", code },
  });

  it("is explained by the robot's report of this epoch", () => {
    expect(reportedEnd(device, 5)).toBeNull();
    deliver("event", event(4, "lease_lost", "Bob took control"));
    deliver("event", event(5, "stopped", "stopped by Bob"));
    expect(reportedEnd(device, 5)).toEqual({ code: "stopped", message: "stopped by Bob" });
    expect(reportedEnd(device, 4)).toEqual({ code: "lease_lost", message: "Bob took control" });
  });
});
