import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { intervalsOf, marksOf, readRow, ticksOf, TIME_RANGES } from "../../../src/features/autonomy/model/fleet-timeline";
import type { StoredSession } from "../../../src/shared/api/autonomy";
import type { StoredEvent } from "../../../src/shared/api/health";
import { FakeServer, list, ok, problem } from "../../support/fake-server";
import { DEVICE } from "../../support/messages";

const at = (time: string): number => Date.parse(`2026-03-15T${time}Z`);
const session = (epoch: number, start: string | null, end: string | null, more: Partial<StoredSession> = {}): StoredSession => ({
  epoch, holder: "demo", action: null, task: null, outcome: null, intervened: false, recorded: false,
  started_at: start === null ? null : `2026-03-15T${start}Z`, ended_at: end === null ? null : `2026-03-15T${end}Z`,
  share: { operator_s: 0, machine_s: 0, hti: null, mti: null, mtia: null }, ...more,
});
const event = (kind: string, time: string): StoredEvent => ({ id: `${kind}${time}`, kind, severity: "info", message: kind, data: {}, at: `2026-03-15T${time}Z` });

describe("sessions on the timeline", () => {
  const shown = (...sessions: StoredSession[]) => intervalsOf(sessions, at("10:00:00"), at("12:00:00"), at("12:00:00"));

  it("include one that began before the shown time, and one that lasts until now", () => {
    const [early, late] = shown(session(5, "11:50:00", null), session(4, "09:00:00", "10:30:00"));
    expect(early).toMatchObject({ epoch: 4, fromMs: at("09:00:00"), toMs: at("10:30:00"), lasts: false, by: "person" });
    expect(late).toMatchObject({ epoch: 5, toMs: at("12:00:00"), lasts: true });
  });

  it("exclude those outside of the shown time, and those without a known start", () => {
    expect(shown(session(1, "08:00:00", "09:59:59"), session(2, "12:00:00", "12:30:00"), session(3, null, "11:00:00"))).toEqual([]);
  });

  it("name an action by its task", () => {
    expect(shown(session(1, "11:00:00", "11:01:00", { action: "a1", task: "wave" }))[0]).toMatchObject({ by: "action", task: "wave", holder: "demo" });
  });
});

describe("events on the timeline", () => {
  it("are Stops, faults and changes of control, oldest first", () => {
    const events = [event("control-taken-over", "11:30:00"), event("activity", "11:20:00"), event("fault-raised", "11:10:00"), event("fault-cleared", "11:05:00"), event("stop-latched", "10:30:00"), event("stop-latched", "09:30:00")];
    const marks = marksOf(events, at("10:00:00"), at("12:00:00"));
    expect(marks.map(({ kind }) => kind)).toEqual(["stop", "fault", "handover"]);
    expect(marks[0]?.atMs).toBe(at("10:30:00"));
  });

  it("show one Stop for an order and its effect, with the name of the person", () => {
    const events = [event("stop-latched", "11:00:01"), event("stop-ordered", "11:00:00"), event("stop-latched", "11:20:00")];
    const marks = marksOf(events, at("10:00:00"), at("12:00:00"));
    expect(marks.map(({ atMs, message }) => [atMs, message])).toEqual([[at("11:00:00"), "stop-ordered"], [at("11:20:00"), "stop-latched"]]);
  });

  it("of an unknown kind are ignored, also if an object has that property", () => {
    expect(marksOf([event("toString", "11:00:00")], at("10:00:00"), at("12:00:00"))).toEqual([]);
  });
});

describe("a row", () => {
  const SESSIONS = `GET /devices/${DEVICE}/sessions`;
  const EVENTS = `GET /devices/${DEVICE}/events`;
  const read = (server: FakeServer) => readRow(server.api, DEVICE, at("10:00:00"), at("12:00:00"), at("12:00:00"));

  it("reads pages until the shown time is complete", async () => {
    const server = new FakeServer();
    server.on(SESSIONS, ({ query }) =>
      query.get("cursor") === null ? ok({ items: [session(9, "11:00:00", "11:30:00")], cursor: "b" }) : ok({ items: [session(8, "09:00:00", "09:30:00")], cursor: "c" }),
    );
    server.on(EVENTS, list(event("stop-latched", "11:10:00")));
    const row = await read(server);
    expect(server.callsTo(SESSIONS).map(({ query }) => query.get("cursor"))).toEqual([null, "b"]);
    expect(row).toMatchObject({ device: DEVICE, complete: true, error: "" });
    expect([row.intervals.length, row.marks.length]).toEqual([1, 1]);
  });

  it("states that entries are missing after ten pages", async () => {
    const server = new FakeServer();
    server.on(EVENTS, ok({ items: [event("activity", "11:00:00")], cursor: "more" }));
    server.on(SESSIONS, list());
    expect(await read(server)).toMatchObject({ complete: false, error: "" });
    expect(server.callsTo(EVENTS)).toHaveLength(10);
  });

  it("that cannot be read contains the reason", async () => {
    const server = new FakeServer();
    server.on(SESSIONS, problem(503, "unavailable", "The store does not respond."));
    server.on(EVENTS, list());
    expect(await read(server)).toMatchObject({ error: "The store does not respond.", intervals: [], marks: [] });
  });
});

describe("marks on the axis", () => {
  beforeEach(() => vi.stubEnv("TZ", "Europe/Bratislava"));
  afterEach(() => vi.unstubAllEnvs());

  it("are round local times inside the shown time", () => {
    const ticks = ticksOf(at("10:07:00"), at("22:07:00"), TIME_RANGES.shift.tickMs); // 11:07 to 23:07 local time
    expect(ticks.map((ms) => new Date(ms).getHours())).toEqual([12, 14, 16, 18, 20, 22]);
  });

  it("stay at midnight in the week in which clocks change", () => {
    const fromMs = Date.parse("2026-03-26T12:00:00Z"); // summer time begins on 29 March
    const ticks = ticksOf(fromMs, fromMs + TIME_RANGES.week.lengthMs, TIME_RANGES.week.tickMs);
    expect(ticks.map((ms) => new Date(ms).getHours())).toEqual([0, 0, 0, 0, 0, 0, 0]);
    expect(ticks.map((ms) => new Date(ms).getDate())).toEqual([27, 28, 29, 30, 31, 1, 2]);
  });
});
