import { describe, expect, it } from "vitest";
import { TOPIC, arm, cloud, device, fleet } from "../../support/console";
import { until } from "../../support/until";

describe("a device", () => {
  it("becomes stale without messages, and online again with the next message", async () => {
    arm().mute = true;
    await until(() => device.reach.value === "stale", "stale");
    arm().mute = false;
    await until(() => device.reach.value === "online", "online");
  });

  it("is offline when the agent reports it, unless the message is from an older session", async () => {
    const conn = "ts/v1/lab/agent00001/conn";
    cloud.tell(conn, { online: true, session: 9, at_ms: Date.now() }, { qos: 1, retain: true });
    cloud.tell(conn, { online: false, session: 8, at_ms: Date.now() }, { qos: 1, retain: true });
    arm().grant(2, null);
    await until(() => device.state.value?.epoch === 2, "what was said after the old will");
    expect(device.presence.value).toMatchObject({ online: true, session: 9 });
    expect(device.reach.value).toBe("online");
    cloud.tell(conn, { online: false, session: 9, at_ms: Date.now() }, { qos: 1, retain: true });
    await until(() => device.reach.value === "offline", "offline");
  });

  it("has unknown reachability while this page has no connection", async () => {
    cloud.brokerDown = true;
    cloud.cutAll();
    await until(() => device.reach.value === "unknown", "unknown");
    cloud.brokerDown = false;
    await until(() => device.reach.value === "online", "online");
  });

  it("keeps its state after an unreadable message", async () => {
    const before = device.state.value;
    cloud.tell(`${TOPIC}/state`, "{\"mode\":", { qos: 1, retain: false });
    await until(() => device.trouble.value !== null, "the complaint");
    expect(device.state.value).toBe(before);
    arm().grant(3, "Ann");
    await until(() => device.trouble.value === null, "the next good message");
    expect(device.state.value?.epoch).toBe(3);
  });

  it("rejects telemetry with a different number of joints", async () => {
    arm().mute = true; // Its next good message would end the complaint.
    const telemetry = { tick_ms: 9e9, at_ms: 9e14, sequence: 1, mode: "idle" };
    const lists = { position_rad: [7], velocity_rad_s: [0], effort_nm: [0], commanded_rad: [7] };
    cloud.tell(`${TOPIC}/tele/joints`, { ...telemetry, ...lists }, { qos: 0, retain: false });
    await until(() => device.trouble.value?.includes("1 joints") === true, "the complaint");
    expect(device.telemetry.value?.message.position_rad).toHaveLength(6);
  });
});

describe("the fleet", () => {
  it("names spaces by id until their names are loaded", async () => {
    await until(() => fleet.spaceName("lab") === "Laboratory", "the name");
    expect(fleet.spaceName("elsewhere")).toBe("elsewhere");
  });
});

describe("the lease holder", () => {
  const lease = (epoch: number, inMs: number): void =>
    device.setLease({ holder: "Cloud", epoch, expires_at: new Date(Date.now() + inMs).toISOString(), mine: false });

  it("is reported by the robot, unless the cloud has a newer lease or the robot is silent", async () => {
    arm().grant(3, "Ann");
    await until(() => device.holder.value?.name === "Ann", "the robot's word");
    lease(2, 60_000);
    expect(device.holder.value?.name).toBe("Ann");
    lease(4, 60_000);
    expect(device.holder.value?.name).toBe("Cloud");
    lease(4, -5_000);
    expect(device.holder.value?.name).toBe("Ann");
    arm().grant(3, null);
    await until(() => device.holder.value === null, "no holder");
    lease(2, 60_000);
    expect(device.holder.value).toBeNull();
    arm().mute = true;
    await until(() => device.holder.value?.name === "Cloud", "the cloud's word");
  });
});

describe("retained messages", () => {
  it("keeps the same objects after a reconnect without changes", async () => {
    await until(() => device.twin.value !== null, "the model");
    const { description, twin } = { description: device.description.value, twin: device.twin.value };
    cloud.cutAll();
    await until(() => !fleet.link.up.value, "the loss");
    await until(() => device.reach.value === "online", "the return");
    expect(device.description.value).toBe(description);
    expect(device.twin.value).toBe(twin);
  });
});
