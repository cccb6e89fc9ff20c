import { beforeEach, describe, expect, it } from "vitest";
import type { ControlRequestInfo, GrantedLease, Watcher } from "../../../src/shared/api/types";
import { Control, LEASE_MS } from "../../../src/features/control/model/lease";
import type { ControlRequestState } from "../../../src/features/control/model/control-request";
import { Watchers } from "../../../src/features/control/model/watchers";
import { SetpointPreference } from "../../../src/features/control/model/setpoint-preference";
import { DeviceStore } from "../../../src/features/devices/model/device-store";
import { storedTransport } from "../../../src/shared/lib/local-storage";
import type { SetpointTransport } from "../../../src/shared/mqtt/mqtt-link";
import { FakeStorage } from "../../support/fake-storage";
import { blockedReason } from "../../../src/features/steering/blocked-notice";
import { texts } from "../../../src/features/steering/texts";
import { deliver, device, ends, link, pass, server } from "../../support/console";
import { FakeLink } from "../../support/fake-link";
import { sealed } from "../../../src/shared/mqtt/sealed-setpoint";
import type { Tagged } from "../../../src/shared/mqtt/protocol.generated";
import { list, none, ok, problem, unreachable, type Answer } from "../../support/fake-server";
import { DEVICE, TOPIC, description, listed, state, telemetry } from "../../support/messages";

const LEASE = `/devices/${DEVICE}/lease`;
const REQUEST = `${LEASE}/requests/r1`;
const KEY = "00".repeat(32);
const EXPIRES = "2030-01-01T00:00:00.000Z";

function granted(epoch: number, confirmed = true, streaming = true): Answer {
  return ok({ epoch, holder: "Ann", expires_at: EXPIRES, lease_ms: LEASE_MS, confirmed, setpoint_key: KEY, streaming } satisfies GrantedLease);
}

function request(outcome: ControlRequestInfo["outcome"] = "open"): ControlRequestInfo {
  const [requested, expires] = [0, 30_000].map((after) => new Date(Date.now() + after).toISOString());
  return { id: "r1", requester: "Bob", requester_account: "bob-id", epoch: 5, mine: true, requested_at: requested ?? "", expires_at: expires ?? "", outcome };
}

let setpoints: FakeLink;
let control: Control;
let renewal: (epoch: number) => Answer | Promise<Answer>;
let renewals: number[];

beforeEach(() => {
  setpoints = new FakeLink();
  renewals = [];
  renewal = (epoch) => granted(epoch);
  server.on(`POST ${LEASE}`, ({ body }) => {
    if (body["take_over"] === true) return granted(6);
    if (body["epoch"] === undefined) return granted(5);
    renewals.push(Number(body["epoch"]));
    return renewal(Number(body["epoch"]));
  });
  server.on(`GET ${LEASE}`, ok({ lease: null }));
  server.on(`DELETE ${LEASE}`, none);
  control = new Control(server.api, device, () => setpoints);
  ends.push(() => control.dispose());
});

const released = (): (string | null)[] => server.callsTo(`DELETE ${LEASE}`).map(({ query }) => query.get("epoch"));

describe("control of a device", () => {
  it("opens no setpoint connection to a device that setpoints do not reach, and keeps the lease", async () => {
    server.on(`POST ${LEASE}`, granted(5, true, false));
    let opened = 0;
    const polled = new Control(server.api, device, () => {
      opened += 1;
      return setpoints;
    });
    ends.push(() => polled.dispose());
    await polled.take();
    expect(polled.state.value).toEqual({ kind: "held", epoch: 5, confirmed: true });
    expect(blockedReason(device, polled)).toBe(texts.steer.noConnection);
    deliver("desc", { ...description, streaming: false });
    expect(blockedReason(device, polled)).toBe(texts.steer.noStreaming);
    expect(opened).toBe(0);
  });

  it("uses the preferred transport if the site offers it, and never changes it during a lease", async () => {
    const opened: string[] = [];
    let preferred: SetpointTransport = "xmpp";
    const open = (_device: string, epoch: number, transport: SetpointTransport): FakeLink => {
      opened.push(`${epoch} ${transport}`);
      const opening = new FakeLink();
      opening.transport = transport;
      return opening;
    };
    const offered = new DeviceStore(listed({ setpoints_over: ["mqtt", "xmpp"] }), server.api, link);
    for (const [store, expected] of [[offered, "xmpp"], [device, "mqtt"]] as const) {
      preferred = "xmpp";
      const chosen = new Control(server.api, store, open, () => preferred);
      ends.push(() => chosen.dispose());
      expect(chosen.transport.value).toBeNull();
      await chosen.take();
      preferred = "mqtt";
      await pass(LEASE_MS);
      expect(chosen.transport.value).toBe(expected);
      await chosen.release();
      expect(chosen.transport.value).toBeNull();
    }
    expect(opened).toEqual(["5 xmpp", "5 mqtt"]);
  });

  it("says why the connection for setpoints is lost", async () => {
    await control.take();
    expect(blockedReason(device, control)).toBeNull();
    setpoints.status.value = { state: "down", reason: "The cable is cut." };
    expect(blockedReason(device, control)).toBe("No connection for setpoints: The cable is cut.");
  });

  it("keeps the choice of a transport in the browser", () => {
    const store = new FakeStorage();
    const preference = (): SetpointPreference => new SetpointPreference(storedTransport(store));
    expect(preference().transport.value).toBe("mqtt");
    preference().choose("xmpp");
    expect(preference().transport.value).toBe("xmpp");
    store.setItem("telescope.setpoints", '"pigeon"');
    expect(preference().transport.value).toBe("mqtt");
  });

  it("is renewed every third of the lease, until it is released with its epoch", async () => {
    await control.take();
    expect(control.state.value).toEqual({ kind: "held", epoch: 5, confirmed: true });
    await pass(LEASE_MS * 3 + 100);
    expect(renewals).toEqual(Array(9).fill(5));
    await control.release();
    expect(released()).toEqual(["5"]);
    expect(control.state.value).toEqual({ kind: "none" });
    expect(setpoints.status.value.state).toBe("closed");
    await pass(LEASE_MS);
    expect(renewals).toHaveLength(9);
  });

  it("is lost immediately when the server rejects the renewal, and the stream ends", async () => {
    await control.take();
    await pass(LEASE_MS / 3 - 500);
    control.streamer.value?.setTarget("elbow", 1);
    for (let passed = 0; passed < 400; passed += 50) {
      deliver("tele/joints", telemetry({ velocity_rad_s: [0, 0, 1, 0, 0, 0] }));
      await pass(50);
    }
    expect(setpoints.published.length).toBeGreaterThan(10);
    renewal = () => problem(409, "lease-lost", "Ann has control.");
    await pass(110);
    expect(control.state.value).toEqual({ kind: "lost", epoch: 5, reason: "Ann has control." });
    expect(control.streamer.value).toBeNull();
    expect(setpoints.status.value.state).toBe("closed");
    const sent = setpoints.published.length;
    await pass(1_000);
    expect(setpoints.published).toHaveLength(sent);
  });

  it("continues after a short outage of the server", async () => {
    await control.take();
    renewal = unreachable;
    await pass(LEASE_MS / 2);
    expect(renewals.length).toBeGreaterThan(3);
    renewal = granted;
    await pass(LEASE_MS * 2);
    expect(control.epoch).toBe(5);
  });

  it("ends when it could not be renewed in time, even if a call hangs", async () => {
    await control.take();
    renewal = () => new Promise(() => undefined);
    await pass(LEASE_MS + 10);
    expect(control.state.value.kind).toBe("lost");
  });

  it.each([
    ["telemetry", "tele/joints", () => telemetry({ epoch: 6 })],
    ["state", "state", () => state(6)],
  ])("is lost immediately when the robot's %s contains a newer epoch", async (_, kind, message) => {
    await control.take();
    deliver(kind, message());
    await pass(1);
    expect(control.state.value.kind).toBe("lost");
  });

  it("is lost and released when the robot has ended it", async () => {
    await control.take();
    deliver("tele/joints", telemetry());
    await pass(1);
    expect(control.epoch).toBe(5);
    deliver("tele/joints", telemetry({ epoch: 0 }));
    await pass(1);
    expect(control.state.value.kind).toBe("lost");
    expect(setpoints.status.value.state).toBe("closed");
    expect(released()).toEqual(["5"]);
  });

  it("is refused while another operator has it; the page names that operator", async () => {
    server.on(`POST ${LEASE}`, problem(409, "lease-held", "Ann has control."));
    server.on(`GET ${LEASE}`, ok({ lease: { holder: "Ann", epoch: 4, expires_at: EXPIRES, mine: false } }));
    await control.take();
    expect(control.state.value).toEqual({ kind: "refused", reason: "Ann has control." });
    expect(control.epoch).toBeNull();
    await pass(1);
    expect(device.lease.value?.holder).toBe("Ann");
  });

  it("is confirmed by the robot if the cloud could not confirm it", async () => {
    server.on(`POST ${LEASE}`, granted(5, false));
    deliver("tele/joints", telemetry({ epoch: 4 }));
    await control.take();
    expect(control.state.value).toMatchObject({ kind: "held", confirmed: false });
    deliver("tele/joints", telemetry());
    await pass(1);
    expect(control.state.value).toMatchObject({ kind: "held", confirmed: true });
  });

  it("publishes setpoints to the topic of its epoch and measures their round trip", async () => {
    await control.take();
    control.streamer.value?.setTarget("elbow", 1);
    const [first] = setpoints.published;
    expect(first?.topic).toBe(`${TOPIC}/ctl/5`);
    const { tag, body } = first?.message as Tagged;
    const { sent_ms, sequence } = body;
    expect(sealed(body, KEY, `${TOPIC}/ctl/5`).tag).toBe(tag);
    await pass(30);
    deliver("tele/joints", telemetry({ setpoint_sequence: sequence, setpoint_sent_ms: sent_ms }));
    await pass(1);
    expect(control.roundTrip.figures.value).toMatchObject({ latestMs: 30, samples: 1 });
  });

  it("is taken over with a reason", async () => {
    await control.takeOver("the arm is needed");
    expect(control.epoch).toBe(6);
    expect(server.callsTo(`POST ${LEASE}`)[0]?.body).toMatchObject({ take_over: true, reason: "the arm is needed" });
  });
});

describe("a request for control", () => {
  let answer: Answer | (() => never);
  const requestState = (): ControlRequestState => control.outgoingRequest.state.value;

  beforeEach(() => {
    device.setLease({ holder: "Ann", holder_account: "ann-id", epoch: 5, expires_at: EXPIRES, mine: false });
    answer = ok(request());
    server.on(`POST ${LEASE}/requests`, () => ok({ request: request(), confirmed: true }));
    server.on(`GET ${REQUEST}`, () => (typeof answer === "function" ? answer() : answer));
    server.on(`DELETE ${REQUEST}`, none);
  });

  it("gives control in the new epoch after it is accepted, without another click", async () => {
    await control.outgoingRequest.send();
    expect(requestState()).toMatchObject({ kind: "open", id: "r1", published: true, holder: "Ann" });
    await pass(2_000);
    expect(control.epoch).toBeNull();
    answer = ok(request("accepted"));
    await pass(1_000);
    expect(control.epoch).toBe(6);
    expect(renewals).toEqual([6]);
    expect(requestState()).toEqual({ kind: "ended", outcome: "accepted", holder: "Ann" });
  });

  it("is read immediately when the robot reports the new epoch", async () => {
    deliver("state", state(5, "Ann", { lease: { holder: "Ann", epoch: 5, expires_in_ms: 30_000, request: { id: "r1", requester: "Bob", expires_in_ms: 30_000 } } }));
    await control.outgoingRequest.send();
    answer = ok(request("accepted"));
    deliver("state", state(6, "Bob"));
    await pass(10);
    expect(control.epoch).toBe(6);
  });

  it.each(["rejected", "expired", "ended"] as const)("reports that it was %s, and gives no control", async (outcome) => {
    await control.outgoingRequest.send();
    answer = ok(request(outcome));
    await pass(1_000);
    expect(requestState()).toEqual({ kind: "ended", outcome, holder: "Ann" });
    expect(control.state.value).toEqual({ kind: "none" });
    control.dismiss();
    expect(requestState()).toEqual({ kind: "none" });
  });

  it("can be withdrawn, unless it was accepted at the same moment", async () => {
    await control.outgoingRequest.send();
    await control.outgoingRequest.withdraw();
    expect(requestState()).toMatchObject({ kind: "ended", outcome: "withdrawn" });
    await control.outgoingRequest.send();
    server.on(`DELETE ${REQUEST}`, problem(409, "control-request-closed", "Accepted."));
    answer = ok(request("accepted"));
    await control.outgoingRequest.withdraw();
    await pass(10);
    expect(control.epoch).toBe(6);
  });

  it("stays open during an outage of the server, until its deadline", async () => {
    await control.outgoingRequest.send();
    answer = unreachable;
    await pass(29_000);
    expect(requestState().kind).toBe("open");
    await pass(8_000);
    expect(requestState()).toMatchObject({ kind: "ended", outcome: "expired" });
  });

  it("reports why it failed", async () => {
    server.on(`POST ${LEASE}/requests`, problem(409, "lease-requested", "Eve has already requested control."));
    await control.outgoingRequest.send();
    expect(requestState()).toEqual({ kind: "failed", reason: "Eve has already requested control." });
  });

  it("is withdrawn when the page closes", async () => {
    await control.outgoingRequest.send();
    control.dispose();
    await pass(5_000);
    expect(server.callsTo(`DELETE ${REQUEST}`)).toHaveLength(1);
    expect(control.epoch).toBeNull();
  });
});

describe("the holder's response to a request", () => {
  const requested = { id: "r1", requester: "Bob", expires_in_ms: 20_000 };

  beforeEach(async () => {
    server.on(`POST ${REQUEST}/accept`, none);
    server.on(`POST ${REQUEST}/reject`, none);
    await control.take();
    deliver("state", state(5, "Ann", { lease: { holder: "Ann", epoch: 5, expires_in_ms: 30_000, request: requested } }));
  });

  it("is possible while the robot reports the request", () => {
    expect(control.incomingRequest.value).toMatchObject({ id: "r1", by: "Bob", account: "" });
    expect((control.incomingRequest.value?.until ?? 0) - performance.now()).toBeCloseTo(20_000, -2);
    deliver("state", state(5, "Ann"));
    expect(control.incomingRequest.value).toBeNull();
  });

  it("is possible for a request that only the cloud reports", () => {
    deliver("state", state(4, "Ann"));
    device.setLease({ holder: "Ann", holder_account: "ann-id", epoch: 5, expires_at: EXPIRES, mine: true, request: request() });
    expect(control.incomingRequest.value).toMatchObject({ id: "r1", by: "Bob", account: "bob-id" });
  });

  it("hands control over and ends the stream; the new operator's lease is not released", async () => {
    const answered = control.respond(true);
    deliver("state", state(6, "Bob")); // The robot's report arrives before the server's response.
    await pass(0);
    expect(control.state.value).toEqual({ kind: "handed", to: "Bob" });
    await answered;
    expect(control.state.value).toEqual({ kind: "handed", to: "Bob" });
    expect(control.streamer.value).toBeNull();
    expect(server.callsTo(`POST ${REQUEST}/accept`)).toHaveLength(1);
    expect(released()).toEqual([]);
  });

  it("keeps control", async () => {
    await control.respond(false);
    expect(control.epoch).toBe(5);
    expect(control.response.value).toEqual({ kind: "kept", from: "Bob" });
  });

  it("keeps control if it was too late", async () => {
    server.on(`POST ${REQUEST}/accept`, problem(409, "control-request-closed", "It was not answered in time."));
    await control.respond(true);
    expect(control.epoch).toBe(5);
    expect(control.response.value).toEqual({ kind: "failed", reason: "It was not answered in time." });
  });
});

describe("the other viewers", () => {
  it("are read while the page is visible; unknown ones are not shown", async () => {
    const bob: Watcher = { name: "Bob", account: "bob-id", role: "viewer", mine: false, since: "2026-01-01T00:00:00.000Z" };
    const viewers = `/devices/${DEVICE}/viewers`;
    server.on(`PUT ${viewers}`, ok({ ...(list(bob).body as object), refresh_ms: 10_000 }));
    server.on(`DELETE ${viewers}`, none);
    const watchers = new Watchers(server.api, DEVICE);
    watchers.setVisible(true);
    watchers.setVisible(true);
    await pass(25_000);
    expect(server.callsTo(`PUT ${viewers}`)).toHaveLength(3);
    expect(watchers.others.value).toEqual([bob]);
    server.on(`PUT ${viewers}`, unreachable);
    await pass(10_000);
    expect(watchers.others.value).toBeNull();
    watchers.setVisible(false);
    await pass(60_000);
    expect(server.calls.map(({ route }) => route.split(" ")[0])).toEqual(["PUT", "PUT", "PUT", "PUT", "DELETE"]);
  });
});
