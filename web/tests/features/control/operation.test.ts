/** Stop, actions and command traces. */
import { beforeEach, describe, expect, it } from "vitest";
import { ActionRunner, ended, released } from "../../../src/features/actions/model/action-runner";
import { Control, LEASE_MS } from "../../../src/features/control/model/lease";
import { CommandTrace } from "../../../src/features/control/model/command-trace";
import { StopSwitch } from "../../../src/features/control/model/stop";
import { deliver, device, ends, link, pass, server } from "../../support/console";
import { FakeLink } from "../../support/fake-link";
import { ok, problem, unreachable } from "../../support/fake-server";
import { DEVICE, TOPIC, description, listed, state, telemetry } from "../../support/messages";

const LEASE = `/devices/${DEVICE}/lease`;
const STOP = `/devices/${DEVICE}/stop`;
const ACTIONS = `POST /devices/${DEVICE}/actions`;

let control: Control;
let setpoints: FakeLink;

beforeEach(() => {
  setpoints = new FakeLink();
  const lease = { epoch: 5, holder: "Demo", expires_at: "2030-01-01T00:00:00.000Z", lease_ms: LEASE_MS, confirmed: true, setpoint_key: "00".repeat(32), streaming: true };
  server.on(`POST ${LEASE}`, ok(lease));
  server.on(`GET ${LEASE}`, ok({ lease: null }));
  control = new Control(server.api, device, () => setpoints);
  ends.push(() => control.dispose());
});

describe("stop", () => {
  let stop: StopSwitch;
  const latched = (): void => deliver("tele/joints", telemetry({ mode: "stopped" }));
  const stops = (): object[] => link.published.filter(({ topic }) => topic === `${TOPIC}/stop/account1`).map(({ message }) => message);

  beforeEach(() => {
    server.on(`POST ${STOP}`, ok({ outcome: "sent" }));
    stop = new StopSwitch(server.api, device, link, "account1");
    ends.push(() => stop.dispose());
  });

  it("is sent over MQTT and HTTP, and republished with a warning until the robot confirms it", async () => {
    stop.press("test");
    expect(stop.state.value).toEqual({ kind: "sending", repeating: true });
    expect(stops()).toMatchObject([{ reason: "test" }]);
    expect(server.callsTo(`POST ${STOP}`)).toHaveLength(1);
    await pass(1_500);
    expect(stop.state.value).toEqual({ kind: "sent", repeating: true });
    expect(stops().length).toBeGreaterThan(4);
    latched();
    await pass(0);
    expect(stop.state.value.kind).toBe("latched");
    const count = stops().length;
    await pass(500);
    expect(stops()).toHaveLength(count);
  });

  it("reaches the cloud while the broker is offline, until the robot's own report arrives", async () => {
    link.set("down");
    server.on(`POST ${STOP}`, ok({ outcome: "confirmed" }));
    stop.press();
    await pass(100);
    expect(stop.state.value.kind).toBe("latched");
    await pass(1_000);
    link.set("up");
    deliver("tele/joints", telemetry());
    await pass(0);
    expect(stop.state.value.kind).toBe("clear");
  });

  it("keeps the error of its reset while the page does not know the robot's state", async () => {
    link.set("down");
    server.on(`POST ${STOP}`, ok({ outcome: "confirmed" }));
    server.on(`POST ${STOP}/reset`, ok({ confirmed: false, reason: null }));
    stop.press();
    await pass(100);
    await stop.reset();
    await pass(100);
    expect(stop.error.value).toBe("The robot has not confirmed the reset yet.");
  });

  it.each([
    [ok({ outcome: "unreachable" }), "unreachable"],
    [problem(503, "broker-unavailable", "No broker."), "unreachable"],
    [ok({ outcome: "sent" }), "sent"],
  ])("shows the outcome, also after it is no longer sent (%#)", async (answer, kind) => {
    server.on(`POST ${STOP}`, answer);
    stop.press();
    await pass(1_500);
    expect(stop.state.value).toEqual({ kind, repeating: true });
    await pass(60_000);
    expect(stop.state.value).toEqual({ kind, repeating: false });
    latched();
    await pass(0);
    expect(stop.state.value.kind).toBe("latched");
  });

  it("of another operator is not shown as applied while the control loop has not applied it", () => {
    const latch = { caller: "Bob", reason: "", at_ms: 1 };
    deliver("state", state(0, null, { mode: "idle", stop: latch }));
    expect(stop.state.value.kind).toBe("sent");
    deliver("state", state(0, null, { mode: "fault", stop: latch }));
    expect(stop.state.value.kind).toBe("fault");
    deliver("state", state(0, null, { mode: "stopped", stop: latch }));
    expect(stop.state.value.kind).toBe("latched");
  });

  it("of the robot itself is shown while its driver reports the cause", () => {
    const latch = { caller: "the device", reason: "protective stop", at_ms: 1 };
    const reported = (code: string): object => state(0, null, { mode: "fault", stop: latch, faults: [{ code, message: "x", since_ms: 1 }] });
    deliver("state", reported("driver.protective-stop"));
    deliver("tele/joints", telemetry({ mode: "fault" }));
    expect(stop.state.value).toEqual({ kind: "latched", repeating: false });
    deliver("state", reported("driver"));
    expect(stop.state.value.kind).toBe("fault");
    deliver("tele/joints", telemetry());
    expect(stop.state.value.kind).toBe("clear");
  });

  it("is not sent for a viewer, and the page shows why", () => {
    device.update(listed({ role: "viewer" }));
    stop.press("test");
    expect(stop.state.value.kind).toBe("clear");
    expect(stop.error.value).toContain("watch");
    expect([stops(), server.callsTo(`POST ${STOP}`)]).toEqual([[], []]);
  });

  it("stays latched until it is reset, and no motion resumes", async () => {
    await control.take();
    control.streamer.value?.setTarget("shoulder_pan", 3);
    control.onStop();
    stop.press();
    latched();
    await pass(300);
    expect(stop.state.value.kind).toBe("latched");
    server.on(`POST ${STOP}/reset`, ok({ confirmed: true, reason: null }));
    await stop.reset();
    deliver("tele/joints", telemetry());
    await pass(300);
    expect(stop.state.value.kind).toBe("clear");
    expect(control.streamer.value?.state.value).toBe("idle");
  });

  it("names the reason of a rejected reset", async () => {
    latched();
    const reason = { code: "device_stopped", message: "the device has stopped itself: protective stop" };
    server.on(`POST ${STOP}/reset`, ok({ confirmed: false, reason }));
    await stop.reset();
    expect(stop.error.value).toBe("The robot rejected the reset: the device has stopped itself: protective stop.");
    expect(stop.state.value.kind).toBe("latched");
    server.on(`POST ${STOP}/reset`, ok({ confirmed: false, reason: null }));
    await stop.reset();
    expect(stop.error.value).toBe("The robot has not confirmed the reset yet.");
    deliver("tele/joints", telemetry());
    deliver("state", state(6));
    await pass(100);
    expect([stop.error.value, stop.state.value.kind]).toEqual([null, "clear"]);
  });
});

const WAVE = { kind: "run_movement", name: "wave" } as const;
const action = (status: string, rest: object = {}): object => ({ id: "x1", status, progress: null, output: "", result: {}, reason: null, ...rest });

function ack(status: string, rest: object = {}): void {
  deliver("ack", { id: "x1", status, sequence: 1, at_ms: Date.now(), tick_ms: 0, ...rest });
}

function runner(): ActionRunner {
  server.on(ACTIONS, ok(action("started")));
  server.on("GET /actions/x1", () => new Promise(() => undefined));
  const actions = new ActionRunner(server.api, device);
  ends.push(() => actions.dispose());
  return actions;
}

describe("an action", () => {
  it("runs under the page's lease, and is tracked from the click to its end, with its output", async () => {
    const actions = runner();
    const started = actions.start(WAVE, 5);
    ack("accepted");
    await started;
    // The cloud's response may overtake the robot's acks: each step is inserted in order.
    ack("started");
    ack("done", { output: "wave: finished\n" });
    expect(actions.run.value).toMatchObject({ status: "done", output: "wave: finished\n" });
    expect(actions.run.value?.steps.map(({ status }) => status)).toEqual(["sent", "accepted", "started", "done"]);
    const [call] = server.callsTo(ACTIONS);
    expect(call?.body["epoch"]).toBe(5);
    expect(call?.headers["Idempotency-Key"]).toMatch(/^[0-9a-f]{32}$/);
  });

  it("ends by the cloud's response if no ack arrives, and can be cancelled", async () => {
    const actions = runner();
    let cancelled = (): void => undefined;
    server.on("GET /actions/x1", () => new Promise((resolve) => (cancelled = () => resolve(ok(action("cancelled"))))));
    server.on("POST /actions/x1/cancel", () => {
      cancelled();
      return ok(action("cancelled"));
    });
    await actions.start(WAVE, null);
    await actions.cancel(null);
    await pass(0);
    expect(actions.run.value?.status).toBe("cancelled");
  });

  it("with an unknown outcome frees the device, and ends when the robot reports", async () => {
    const actions = runner();
    const unknown = { ...action("unknown"), reason: { code: "no-report", message: "Not reported." } };
    server.on("GET /actions/x1", () => ok(unknown));
    const run = await actions.startAndWait(WAVE, { epoch: null });
    expect(run).toMatchObject({ status: "unknown", reason: "Not reported." });
    expect([released(run), ended(run)]).toEqual([true, false]);
    ack("done");
    expect(actions.run.value).toMatchObject({ status: "done", reason: "" });
    expect(actions.run.value?.steps.map(({ status }) => status)).toEqual(["sent", "started", "unknown", "done"]);
  });

  it("reports why it was rejected", async () => {
    const actions = runner();
    server.on(ACTIONS, problem(409, "device-busy", "The arm is running home."));
    await actions.start(WAVE, null);
    expect(actions.run.value).toMatchObject({ status: "refused", reason: "The arm is running home." });
  });

  it("is sent again with the same key if the server was unreachable", async () => {
    const actions = runner();
    let attempts = 0;
    server.on(ACTIONS, () => ((attempts += 1) === 1 ? unreachable() : ok(action("started"))));
    await actions.start(WAVE, null);
    const keys = server.callsTo(ACTIONS).map(({ headers }) => headers["Idempotency-Key"]);
    expect([keys.length, new Set(keys).size]).toEqual([2, 1]);
  });

  it("can be undone: each joint returns to its position at the click, with collision avoidance", async () => {
    const actions = runner();
    deliver("desc", { ...description, actions: ["move_joints", "take_posture", "say"] });
    deliver("tele/joints", telemetry({ position_rad: [0, 0, 1.5, 0, 0, 0] }));
    const { undo } = await actions.start({ kind: "take_posture", name: "Sit" }, null);
    expect(undo).toMatchObject({ kind: "move_joints", plan: true, position_rad: { elbow: 1.5 } });
    expect((await actions.start({ kind: "say", text: "Yes." }, null)).undo).toBeNull();
  });
});

describe("a command trace", () => {
  let actions: ActionRunner;
  let trace: CommandTrace;

  beforeEach(async () => {
    actions = runner();
    trace = new CommandTrace(device, control, actions);
    ends.push(() => trace.dispose());
    await control.take();
  });

  it("has one line for a stream, from its first setpoint to its target", async () => {
    control.streamer.value?.setTarget("elbow", 0.1);
    for (let step = 1; step <= 30; step += 1) {
      await pass(50);
      const position_rad = [0, 0, Math.min(0.1, step / 25), 0, 0, 0];
      const echo = { setpoint_sequence: setpoints.published.length, setpoint_sent_ms: performance.now() };
      deliver("tele/joints", telemetry({ mode: "streaming", position_rad, commanded_rad: position_rad, ...echo }));
    }
    expect(trace.lines.value).toHaveLength(1);
    const [line] = trace.lines.value;
    expect(line).toMatchObject({ request: { kind: "stream" }, reason: "reached", observedBy: "motion" });
    expect(line?.steps.map(({ status }) => status)).toEqual(["sent", "accepted", "started", "observed", "done"]);
    const times = line?.steps.map(({ afterMs }) => afterMs) ?? [];
    expect(times).toEqual(times.toSorted((a, b) => a - b));
  });

  it("contains the robot's acks, and its state if the action moves nothing", async () => {
    await actions.start({ kind: "say", text: "Good morning." }, 5);
    ack("accepted");
    deliver("tele/joints", telemetry({ mode: "action" }));
    expect(trace.lines.value[0]).toMatchObject({ status: "started", observedBy: "state" });
    ack("done");
    const [line] = trace.lines.value;
    expect(line?.status).toBe("done");
    expect(line?.steps.map(({ source }) => source)).toEqual(["page", "device", "cloud", "device", "device"]);
  });

  it("does not report motion that did not occur", async () => {
    await actions.start({ kind: "take_posture", name: "Sit" }, 5);
    deliver("tele/joints", telemetry({ mode: "action" }));
    expect(trace.lines.value[0]?.observedBy).toBeNull();
    ack("done");
    await pass(500);
    deliver("tele/joints", telemetry());
    expect(trace.lines.value[0]?.observedBy).toBe("state");
  });
});
