/** Control, Stop, actions and command traces against a broker and a simulated arm. */
import { describe, expect, it } from "vitest";
import { ActionRunner } from "../../../src/features/actions/model/action-runner";
import { Control } from "../../../src/features/control/model/lease";
import { CommandTrace } from "../../../src/features/control/model/command-trace";
import { StopSwitch } from "../../../src/features/control/model/stop";
import { description } from "../../support/arm";
import { DEVICE, problem } from "../../support/cloud";
import { TOPIC, api, arm, cloud, device, ends, fleet } from "../../support/console";
import { until } from "../../support/until";

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

describe("control", () => {
  it("moves only the commanded joint to its target", async () => {
    const control = await takeControl();
    const before = { ...arm().positions };
    control.streamer.value?.setTarget("elbow", 1.2);
    await until(() => control.streamer.value?.ended.value === "reached", "the target");
    expect(arm().positions["elbow"]).toBeCloseTo(1.2, 3);
    expect(arm().positions["wrist_1"]).toBeCloseTo(before["wrist_1"] ?? NaN, 3);
    expect(arm().setpoints[0]?.sequence).toBe(1);
    expect(control.roundTrip.figures.value?.samples).toBeGreaterThan(0);
  });

  it("is not granted while another operator has it", async () => {
    cloud.lease = { holder: "Ann", epoch: 4, expires_at: "2030-01-01T00:00:00.000Z", mine: false, session: "s2" };
    const control = new Control(api, device);
    await control.take();
    expect(control.state.value).toEqual({ kind: "refused", why: "Ann has control." });
    await until(() => device.lease.value?.holder === "Ann", "the holder");
  });

  it("closes the setpoint connection on release", async () => {
    const control = await takeControl();
    expect(cloud.connections).toBe(2);
    await control.release();
    expect(cloud.lease).toBeNull();
    await until(() => cloud.connections === 1, "the end of the connection");
  });

  it("continues after the setpoint connection is lost and restored", async () => {
    const control = await takeControl();
    cloud.cutAll();
    await until(() => control.linkStatus.value?.state === "down", "the loss");
    await until(() => control.linkStatus.value?.state === "up" && device.reach.value === "online", "the connections");
    control.streamer.value?.setTarget("elbow", 1.4);
    await until(() => control.streamer.value?.ended.value === "reached", "the target");
  });
});

describe("stop", () => {
  it("is sent over MQTT and HTTP and confirmed by the robot", async () => {
    const stop = stopSwitch();
    stop.press("test");
    expect(stop.state.value.kind).toBe("sending");
    await until(() => stop.state.value.kind === "latched", "the latch");
    expect(arm().stop).toMatchObject({ caller: "Demo", reason: "test" });
    await until(() => cloud.callsTo("POST", `/devices/${DEVICE}/stop`).length === 1, "the call");
  });

  it("is republished, with a warning, until the robot confirms it", async () => {
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

  it("reaches the cloud while the broker is offline", async () => {
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

  it("is not sent for a viewer, and the page shows why", async () => {
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

  it("stays latched until it is reset, and no motion resumes", async () => {
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
  it("is tracked from the click to its end, with its output", async () => {
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

  it("reports why it was rejected", async () => {
    cloud.instead.set(`POST /devices/${DEVICE}/actions`, () => problem(409, "device-busy", "The arm is running home."));
    const actions = new ActionRunner(api, device);
    await actions.start({ kind: "run_movement", name: "wave" }, null);
    expect(actions.run.value).toMatchObject({ status: "refused", why: "The arm is running home." });
  });

  it("runs under the page's lease, and once per click", async () => {
    const control = await takeControl();
    const actions = new ActionRunner(api, device);
    ends.push(() => actions.dispose());
    await actions.start({ kind: "run_movement", name: "home" }, control.epoch);
    const [call] = cloud.callsTo("POST", `/devices/${DEVICE}/actions`);
    expect(call?.body["epoch"]).toBe(control.epoch);
    expect(call?.headers["idempotency-key"]).toMatch(/^[0-9a-f]{32}$/);
  });
});

describe("a command trace", () => {
  function evidence(control: Control, actions: ActionRunner): CommandTrace {
    const made = new CommandTrace(device, control, actions);
    ends.push(() => made.dispose(), () => actions.dispose());
    return made;
  }

  it("has one line for a stream, from its first setpoint to its target", async () => {
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

  it("contains the robot's acks, and its state where nothing moves", async () => {
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

  it("does not report motion that did not occur", async () => {
    const control = await takeControl();
    const actions = new ActionRunner(api, device);
    const told = evidence(control, actions);
    await actions.start({ kind: "take_posture", name: "Sit" }, control.epoch);
    await until(() => device.telemetry.value?.message.mode === "action", "the action");
    expect(told.lines.value[0]?.seenBy).toBeNull();
    await until(() => told.lines.value[0]?.seenBy === "state", "the end, and what was seen until then");
  });
});

describe("the undo request", () => {
  it("returns every joint to its position at the click, with collision avoidance", async () => {
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
