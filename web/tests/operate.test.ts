/** The core as a whole, against a broker over a real WebSocket and a small robot. */
import { afterEach, beforeEach, describe, expect, it } from "vitest";
import { ActionRunner } from "../src/features/actions/model/action-runner";
import { Api } from "../src/shared/api/client";
import { ApiError } from "../src/shared/api/http";
import { startClock } from "../src/shared/lib/clock";
import { Control } from "../src/features/control/model/lease";
import type { DeviceStore } from "../src/features/devices/model/device-store";
import { CommandTrace } from "../src/features/control/model/command-trace";
import { Fleet } from "../src/features/devices/model/device-list";
import { RoundTrip } from "../src/features/latency/model/round-trip";
import { LatencySamples } from "../src/features/latency/model/sample-upload";
import { Session } from "../src/features/account/model/session";
import { StopSwitch } from "../src/features/control/model/stop";
import { description } from "./support/arm";
import { Cloud, DEVICE, problem } from "./support/cloud";
import { until } from "./support/until";

const TOPIC = "ts/v1/lab/agent00001/arm";

let cloud: Cloud;
let api: Api;
let fleet: Fleet;
let device: DeviceStore;
let ends: (() => void)[];

beforeEach(async () => {
  cloud = new Cloud();
  await cloud.start();
  api = new Api(`${cloud.address}/api/v1`);
  await api.me();
  fleet = new Fleet(api);
  ends = [startClock(), () => fleet.dispose()];
  await until(() => fleet.devices.value?.has(DEVICE) === true, "the list");
  const found = fleet.devices.value?.get(DEVICE);
  if (found === undefined) throw new Error("no device");
  device = found;
  ends.push(device.watchClosely());
  await until(() => device.reach.value === "online" && device.description.value !== null, "the device");
});

afterEach(async () => {
  for (const end of ends.reverse()) end();
  await cloud.stop();
});

function arm(): NonNullable<Cloud["arm"]> {
  if (cloud.arm === null) throw new Error("no arm");
  return cloud.arm;
}

function stopSwitch(): StopSwitch {
  const stop = new StopSwitch(api, device, fleet.link, "Demo");
  ends.push(() => stop.dispose());
  return stop;
}

async function takeControl(): Promise<Control> {
  const control = new Control(api, device);
  ends.push(() => control.dispose());
  await control.take();
  expect(control.state.value.kind).toBe("held");
  await until(() => control.linkStatus.value?.state === "up", "the connection for setpoints");
  return control;
}

describe("a session", () => {
  it("begins with a link and ends at sign-out", async () => {
    const session = new Session(api);
    await session.start("good");
    expect(session.state.value).toMatchObject({ kind: "in", account: { name: "Demo" } });
    await session.signOut();
    expect(session.state.value).toEqual({ kind: "out", why: "" });
  });

  it("begins with a name and a password, or says what is wrong with them", async () => {
    const session = new Session(api);
    await expect(session.enter("demo", "wrong")).rejects.toMatchObject({ status: 401 });
    expect(session.state.value.kind).not.toBe("in");
    await session.enter("demo", "right");
    expect(session.state.value).toMatchObject({ kind: "in", account: { name: "Demo" } });
  });

  it("says what went wrong elsewhere to who is not signed in, and to nobody else", async () => {
    const session = new Session(api);
    await session.start(null, "Not there.");
    expect(session.state.value.kind).toBe("in");
    cloud.instead.set("GET /accounts/me", () => problem(401, "unauthorized", "Sign in first."));
    await session.start(null, "Not there.");
    expect(session.state.value).toEqual({ kind: "out", why: "Not there." });
  });

  it("says why a link did not work, and nothing at a first visit", async () => {
    const session = new Session(api);
    await session.start("used");
    expect(session.state.value).toMatchObject({ kind: "out", why: expect.stringContaining("used before") as string });
    cloud.instead.set("GET /accounts/me", () => problem(401, "signed-out", "You are not signed in."));
    await session.start(null);
    expect(session.state.value).toEqual({ kind: "out", why: "" });
  });

  it("shows the session's token with what it changes, and with nothing else", () => {
    const [call] = cloud.callsTo("POST", "/mqtt/credentials");
    expect(call?.headers["x-csrf-token"]).toBe("of-this-session");
    expect(cloud.callsTo("GET", "/devices")[0]?.headers["x-csrf-token"]).toBeUndefined();
  });

  it("takes the token of the session that another tab has begun, once", async () => {
    cloud.csrf = "of-another-session";
    expect((await api.stop(DEVICE, "test")).confirmed).toBe(false);
    expect(cloud.callsTo("POST", `/devices/${DEVICE}/stop`)).toHaveLength(2);
    cloud.instead.set(`POST /devices/${DEVICE}/stop`, () => problem(403, "csrf-token", "No."));
    await expect(api.stop(DEVICE, "test")).rejects.toMatchObject({ status: 403, code: "csrf-token" });
    expect(cloud.callsTo("POST", `/devices/${DEVICE}/stop`)).toHaveLength(4);
  });

  it("tells a server that is away from one that refuses", async () => {
    const away = new Api("http://127.0.0.1:9/api/v1");
    await expect(away.me()).rejects.toMatchObject({ status: 0, code: "unreachable" });
    await expect(api.claim("BCDF-GHJK")).rejects.toMatchObject({ status: 404, code: "claim-code-unknown" });
    await expect(api.claim("BCDF-GHJK")).rejects.toBeInstanceOf(ApiError);
  });
});

describe("what is known of a device", () => {
  it("turns stale when it falls silent, and live again when it speaks", async () => {
    arm().mute = true;
    await until(() => device.reach.value === "stale", "stale");
    arm().mute = false;
    await until(() => device.reach.value === "online", "online");
  });

  it("is offline at the agent's word, unless that is older news", async () => {
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

  it("is unknown while this page has no connection", async () => {
    cloud.brokerDown = true;
    cloud.cutAll();
    await until(() => device.reach.value === "unknown", "unknown");
    cloud.brokerDown = false;
    await until(() => device.reach.value === "online", "online");
  });

  it("does not change by a message that cannot be read", async () => {
    const before = device.state.value;
    cloud.tell(`${TOPIC}/state`, "{\"mode\":", { qos: 1, retain: false });
    await until(() => device.trouble.value !== null, "the complaint");
    expect(device.state.value).toBe(before);
    arm().grant(3, "Ann");
    await until(() => device.trouble.value === null, "the next good message");
    expect(device.state.value?.epoch).toBe(3);
  });

  it("refuses telemetry for another number of joints", async () => {
    arm().mute = true; // Its next good message would end the complaint.
    const telemetry = { tick_ms: 9e9, at_ms: 9e14, sequence: 1, mode: "idle" };
    const lists = { position_rad: [7], velocity_rad_s: [0], effort_nm: [0], commanded_rad: [7] };
    cloud.tell(`${TOPIC}/tele/joints`, { ...telemetry, ...lists }, { qos: 0, retain: false });
    await until(() => device.trouble.value?.includes("1 joints") === true, "the complaint");
    expect(device.telemetry.value?.message.position_rad).toHaveLength(6);
  });
});

describe("the fleet", () => {
  it("knows spaces by their names, and by their ids until it does", async () => {
    await until(() => fleet.spaceName("lab") === "Laboratory", "the name");
    expect(fleet.spaceName("elsewhere")).toBe("elsewhere");
  });
});

describe("who has control", () => {
  const lease = (epoch: number, inMs: number): void =>
    device.setLease({ holder: "Cloud", epoch, expires_at: new Date(Date.now() + inMs).toISOString(), mine: false });

  it("is told by the robot, unless the cloud knows of a newer lease or the robot is not heard", async () => {
    arm().grant(3, "Ann");
    await until(() => device.holder.value?.name === "Ann", "the robot's word");
    lease(2, 60_000);
    expect(device.holder.value?.name).toBe("Ann");
    lease(4, 60_000);
    expect(device.holder.value?.name).toBe("Cloud");
    lease(4, -5_000);
    expect(device.holder.value?.name).toBe("Ann");
    arm().grant(3, null);
    await until(() => device.holder.value === null, "nobody");
    lease(2, 60_000);
    expect(device.holder.value).toBeNull();
    arm().mute = true;
    await until(() => device.holder.value?.name === "Cloud", "the cloud's word");
  });
});

describe("what is retained", () => {
  it("is read anew only when it has changed, so that nothing drawn from it is built again", async () => {
    await until(() => device.twin.value !== null, "the model");
    const { description, twin } = { description: device.description.value, twin: device.twin.value };
    cloud.cutAll();
    await until(() => !fleet.link.up.value, "the loss");
    await until(() => device.reach.value === "online", "the return");
    expect(device.description.value).toBe(description);
    expect(device.twin.value).toBe(twin);
  });
});

describe("an operator", () => {
  it("moves the arm: it goes where the target is, and only that joint", async () => {
    const control = await takeControl();
    const before = { ...arm().positions };
    control.streamer.value?.setTarget("elbow", 1.2);
    await until(() => control.streamer.value?.ended.value === "reached", "the target");
    expect(arm().positions["elbow"]).toBeCloseTo(1.2, 3);
    expect(arm().positions["wrist_1"]).toBeCloseTo(before["wrist_1"] ?? NaN, 3);
    expect(arm().setpoints[0]?.sequence).toBe(1);
    expect(control.roundTrip.figures.value?.samples).toBeGreaterThan(0);
  });

  it("cannot take what another holds", async () => {
    cloud.lease = { holder: "Ann", epoch: 4, expires_at: "2030-01-01T00:00:00.000Z", mine: false, session: "s2" };
    const control = new Control(api, device);
    await control.take();
    expect(control.state.value).toEqual({ kind: "refused", why: "Ann has control." });
    await until(() => device.lease.value?.holder === "Ann", "the holder");
  });

  it("gives control back, and the connection for setpoints closes with it", async () => {
    const control = await takeControl();
    expect(cloud.connections).toBe(2);
    await control.release();
    expect(cloud.lease).toBeNull();
    await until(() => cloud.connections === 1, "the end of the connection");
  });

  it("keeps control while the connection for setpoints is cut, and comes back", async () => {
    const control = await takeControl();
    cloud.cutAll();
    await until(() => control.linkStatus.value?.state === "down", "the loss");
    await until(() => control.linkStatus.value?.state === "up" && device.reach.value === "online", "the connections");
    control.streamer.value?.setTarget("elbow", 1.4);
    await until(() => control.streamer.value?.ended.value === "reached", "the target");
  });
});

describe("stop", () => {
  it("goes out by both ways and is confirmed by the robot", async () => {
    const stop = stopSwitch();
    stop.press("test");
    expect(stop.state.value.kind).toBe("sending");
    await until(() => stop.state.value.kind === "latched", "the latch");
    expect(arm().stop).toMatchObject({ caller: "Demo", reason: "test" });
    await until(() => cloud.callsTo("POST", `/devices/${DEVICE}/stop`).length === 1, "the call");
  });

  it("is repeated until the robot says that it has stopped, and the page says so meanwhile", async () => {
    arm().deaf = true;
    const stop = stopSwitch();
    stop.press();
    await until(() => arm().stops >= 4, "repetitions");
    await until(() => stop.state.value.kind === "sending" && stop.state.value.doubtful, "the warning");
    arm().deaf = false;
    await until(() => stop.state.value.kind === "latched", "the latch");
    const count = arm().stops;
    await new Promise((resolve) => setTimeout(resolve, 500));
    expect(arm().stops).toBe(count);
  });

  it("reaches the cloud while the broker is away", async () => {
    cloud.brokerDown = true;
    cloud.cutAll();
    await until(() => !fleet.link.up.value, "the loss");
    cloud.instead.set(`POST /devices/${DEVICE}/stop`, () => ({ status: 200, body: { confirmed: true } }));
    const stop = stopSwitch();
    stop.press();
    await until(() => stop.state.value.kind === "latched", "the confirmation by the cloud");
    cloud.brokerDown = false;
    // The arm of this test has not stopped: once it is heard again, its own word counts.
    await until(() => stop.state.value.kind === "clear", "the robot's own word");
  });

  it("is not for who only watches: nothing goes out, and the page says so", async () => {
    cloud.role = "viewer";
    await fleet.refresh();
    const stop = stopSwitch();
    stop.press("test");
    expect(stop.state.value.kind).toBe("clear");
    expect(stop.problem.value).toContain("watch");
    await fleet.refresh();
    expect(cloud.callsTo("POST", `/devices/${DEVICE}/stop`)).toEqual([]);
    expect(arm().stop).toBeNull();
  });

  it("stays latched until it is reset, and then nothing resumes", async () => {
    const control = await takeControl();
    const stop = stopSwitch();
    control.streamer.value?.setTarget("shoulder_pan", 3);
    await until(() => (arm().positions["shoulder_pan"] ?? 0) > 0.05, "motion");
    control.stopped();
    stop.press();
    await until(() => stop.state.value.kind === "latched", "the latch");
    const count = arm().setpoints.length;
    await stop.reset();
    await until(() => stop.state.value.kind === "clear", "the reset");
    const position = arm().positions["shoulder_pan"];
    await new Promise((resolve) => setTimeout(resolve, 300));
    expect(arm().setpoints).toHaveLength(count);
    expect(arm().positions["shoulder_pan"]).toBe(position);
  });
});

describe("a movement", () => {
  it("is followed from the click to its end, with what it printed", async () => {
    const actions = new ActionRunner(api, device);
    ends.push(() => actions.dispose());
    await actions.start({ kind: "run_movement", name: "wave" }, null);
    expect(actions.run.value?.status).toBe("started");
    await until(() => actions.run.value?.status === "done", "the end");
    // The cloud's answer may overtake the robot's acks: each step is there in the end, in its place.
    await until(() => actions.run.value?.steps.length === 4, "every step");
    expect(actions.run.value?.steps.map((step) => step.status)).toEqual(["sent", "accepted", "started", "done"]);
    expect(actions.run.value?.output).toBe("wave: finished\n");
  });

  it("can be cancelled", async () => {
    const actions = new ActionRunner(api, device);
    ends.push(() => actions.dispose());
    await actions.start({ kind: "run_movement", name: "wave" }, null);
    await actions.cancel(null);
    await until(() => actions.run.value?.status === "cancelled", "the end");
  });

  it("says why it was refused", async () => {
    cloud.instead.set(`POST /devices/${DEVICE}/actions`, () => problem(409, "device-busy", "The arm is running home."));
    const actions = new ActionRunner(api, device);
    await actions.start({ kind: "run_movement", name: "wave" }, null);
    expect(actions.run.value).toMatchObject({ status: "refused", why: "The arm is running home." });
  });

  it("runs under the lease that the page holds, and once for one click", async () => {
    const control = await takeControl();
    const actions = new ActionRunner(api, device);
    ends.push(() => actions.dispose());
    await actions.start({ kind: "run_movement", name: "home" }, control.epoch);
    const [call] = cloud.callsTo("POST", `/devices/${DEVICE}/actions`);
    expect(call?.body["epoch"]).toBe(control.epoch);
    expect(call?.headers["idempotency-key"]).toMatch(/^[0-9a-f]{32}$/);
  });
});

describe("what became of a command", () => {
  function evidence(control: Control, actions: ActionRunner): CommandTrace {
    const made = new CommandTrace(device, control, actions);
    ends.push(() => made.dispose(), () => actions.dispose());
    return made;
  }

  it("is one line for a stream, from its first setpoint to where it was to go", async () => {
    const control = await takeControl();
    const told = evidence(control, new ActionRunner(api, device));
    control.streamer.value?.setTarget("elbow", 1.2);
    await until(() => told.lines.value[0]?.status === "done", "the end of the stream");
    const [line, other] = told.lines.value;
    expect(other).toBeUndefined();
    expect(line).toMatchObject({ request: { kind: "stream" }, why: "reached", seenBy: "motion" });
    expect(line?.steps.map(({ status }) => status)).toEqual(["sent", "accepted", "started", "observed", "done"]);
    const times = line?.steps.map(({ afterMs }) => afterMs) ?? [];
    expect(times).toEqual(times.toSorted((a, b) => a - b));
  });

  it("is heard from the robot, and seen by its own word where nothing moves", async () => {
    const control = await takeControl();
    const actions = new ActionRunner(api, device);
    const told = evidence(control, actions);
    void actions.start({ kind: "say", text: "Good morning." }, control.epoch);
    expect(told.lines.value[0]?.status).toBe("sent");
    await until(() => told.lines.value[0]?.status === "done", "the end");
    const [line] = told.lines.value;
    expect(line?.seenBy).toBe("state");
    expect(line?.steps.filter(({ heard }) => heard === "device").length).toBeGreaterThan(0);
  });

  it("is not said to have moved where it has not", async () => {
    const control = await takeControl();
    const actions = new ActionRunner(api, device);
    const told = evidence(control, actions);
    await actions.start({ kind: "take_posture", name: "Sit" }, control.epoch);
    await until(() => device.telemetry.value?.message.mode === "action", "the action");
    expect(told.lines.value[0]?.seenBy).toBeNull();
    await until(() => told.lines.value[0]?.seenBy === "state", "the end, and what was seen until then");
  });
});

describe("what undoes a request", () => {
  it("goes back to where every joint was at the click, around what is in between", async () => {
    cloud.tell(`${TOPIC}/desc`, { ...description, actions: ["move_joints", "take_posture", "say"] }, { qos: 1, retain: true });
    await until(() => device.description.value?.actions.includes("move_joints") === true, "what it takes");
    const actions = new ActionRunner(api, device);
    ends.push(() => actions.dispose());
    const { back } = await actions.start({ kind: "take_posture", name: "Sit" }, null);
    expect(back).toMatchObject({ kind: "move_joints", plan: true });
    expect(back?.kind === "move_joints" && back.position_rad["elbow"]).toBeCloseTo(arm().positions["elbow"] ?? NaN, 3);
    expect((await actions.start({ kind: "say", text: "Yes." }, null)).back).toBeNull();
  });
});

describe("times", () => {
  it("go to the cloud in one batch, and once: what did not arrive goes again with the same key", async () => {
    const path = `/devices/${DEVICE}/latency`;
    cloud.instead.set(`POST ${path}`, () => problem(503, "busy", "Later."));
    const roundTrip = new RoundTrip();
    const samples = new LatencySamples(api, DEVICE, roundTrip, 600_000);
    ends.push(() => samples.dispose());
    await samples.send();
    expect(cloud.callsTo("POST", path)).toEqual([]);
    roundTrip.seen(1, 1000, 1012);
    roundTrip.seen(2, 1020, 1035);
    await samples.send();
    cloud.instead.set(`POST ${path}`, () => ({ status: 204, body: null }));
    await samples.send();
    const [first, again, ...more] = cloud.callsTo("POST", path);
    expect(first?.body).toMatchObject({ transport: "websocket", path: "operator-device", samples: [{ ms: 12 }, { ms: 15 }] });
    expect(again?.body).toEqual(first?.body);
    expect(again?.headers["idempotency-key"]).toBe(first?.headers["idempotency-key"]);
    expect(more).toEqual([]);
    // Of the call that arrived the time is known too, and goes with the next.
    await samples.send();
    expect(cloud.callsTo("POST", path)[2]?.body).toMatchObject({ transport: "http", path: "operator-cloud" });
  });
});
