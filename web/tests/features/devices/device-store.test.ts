import { describe, expect, it } from "vitest";
import { Fleet } from "../../../src/features/devices/model/device-list";
import { holdingFault } from "../../../src/features/devices/model/faults";
import { deliver, device, ends, link, pass, server } from "../../support/console";
import { list } from "../../support/fake-server";
import { description, listed, state, telemetry, twin } from "../../support/messages";

describe("a device", () => {
  it("becomes stale within a second without messages, and online again with the next message", async () => {
    deliver("tele/joints", telemetry());
    expect(device.reach.value).toBe("online");
    await pass(1_000);
    expect(device.reach.value).toBe("stale");
    deliver("tele/joints", telemetry());
    await pass(250);
    expect(device.reach.value).toBe("online");
  });

  it("is offline when the agent reports it, unless the message is from an older session", () => {
    const conn = (online: boolean, session: number): void => deliver("conn", { online, session, at_ms: Date.now() });
    conn(true, 9);
    conn(false, 8);
    expect(device.presence.value).toMatchObject({ online: true, session: 9 });
    expect(device.reach.value).toBe("online");
    conn(false, 9);
    expect(device.reach.value).toBe("offline");
  });

  it("has unknown reachability while this page has no connection", () => {
    link.set("down");
    expect(device.reach.value).toBe("unknown");
    link.set("up");
    expect(device.reach.value).toBe("online");
  });

  it("names the newest fault that holds it, also while it is online", () => {
    const fault = (code: string, since_ms: number): object => ({ code, message: `${code} has failed`, since_ms, last_ms: since_ms });
    expect(holdingFault(device)).toBeNull();
    deliver("state", state(2, null, { mode: "idle", faults: [fault("recording", 1)] }));
    expect(holdingFault(device)).toBeNull(); // it operates in spite of this fault
    deliver("state", state(2, null, { mode: "fault", faults: [fault("driver.drive", 3), fault("recording", 1)] }));
    deliver("tele/joints", telemetry({ mode: "fault" }));
    expect([holdingFault(device), device.reach.value]).toEqual(["driver.drive has failed", "online"]);
    deliver("state", state(2, null, { mode: "fault", stop: { caller: "ann", reason: "", since_ms: 1 }, faults: [fault("recording", 1), fault("driver.drive", 3)] }));
    expect(holdingFault(device)).toBe("driver.drive has failed");
    deliver("state", state(2, null, { mode: "fault", faults: [] }));
    expect(holdingFault(device)).toBe("");
    deliver("state", state(2, null, { mode: "idle", faults: [] }));
    expect(holdingFault(device)).toBeNull();
  });

  it("keeps its state after an unreadable message", () => {
    deliver("state", state(2));
    const before = device.state.value;
    deliver("state", '{"mode":');
    expect(device.parseError.value).not.toBeNull();
    expect(device.state.value).toBe(before);
    deliver("state", state(3));
    expect(device.parseError.value).toBeNull();
    expect(device.state.value?.epoch).toBe(3);
  });

  it("rejects telemetry with a different number of joints", () => {
    deliver("tele/joints", telemetry({ position_rad: [7], velocity_rad_s: [0], effort_nm: [0], commanded_rad: [7] }));
    expect(device.parseError.value).toContain("1 joints");
    expect(device.telemetry.value?.message.position_rad).toHaveLength(6);
  });

  it("keeps the same objects when retained messages arrive again unchanged", () => {
    deliver("desc/twin", twin);
    const before = [device.description.value, device.twin.value];
    deliver("desc", description);
    deliver("desc/twin", twin);
    expect(device.description.value).toBe(before[0]);
    expect(device.twin.value).toBe(before[1]);
  });
});

describe("the lease holder", () => {
  it("is reported by the robot, unless the cloud has a newer lease or the robot sends nothing", async () => {
    const lease = (epoch: number, inMs: number): void =>
      device.setLease({ holder: "Cloud", holder_account: "cloud-id", epoch, expires_at: new Date(Date.now() + inMs).toISOString(), mine: false });
    deliver("state", state(3, "Ann"));
    lease(2, 60_000);
    expect(device.holder.value?.name).toBe("Ann");
    lease(4, 60_000);
    expect(device.holder.value).toMatchObject({ name: "Cloud", account: "cloud-id" });
    lease(4, -5_000);
    expect(device.holder.value?.name).toBe("Ann");
    deliver("state", state(3));
    lease(2, 60_000);
    expect(device.holder.value).toBeNull();
    await pass(1_500);
    expect(device.holder.value?.name).toBe("Cloud");
  });
});

describe("the fleet", () => {
  it("names spaces, and is refreshed immediately when the connection is lost", async () => {
    server.on("GET /devices", list(listed()));
    server.on("GET /spaces", list({ id: "lab", name: "Laboratory" }));
    const fleet = new Fleet(server.api, link);
    ends.push(() => fleet.dispose());
    expect(fleet.spaceName("lab")).toBe("lab");
    await pass(1_000);
    expect(fleet.spaceName("lab")).toBe("Laboratory");
    expect(fleet.devices.value?.size).toBe(1);
    server.on("GET /devices", list());
    link.set("down");
    await pass(1_000);
    expect(fleet.devices.value?.size).toBe(0);
  });
});
