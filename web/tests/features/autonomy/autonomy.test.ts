import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { barsOf, durationText, metricsOf, ratioText, secondsOf, SessionHistory, shareText, SPANS, type Span, startOf } from "../../../src/features/autonomy/model";
import type { Autonomy, MotionShare, StoredSession } from "../../../src/shared/api/autonomy";
import { FakeServer, ok, problem } from "../../support/fake-server";
import { DEVICE } from "../../support/messages";

const share = (operator_s: number, machine_s: number): MotionShare => ({ operator_s, machine_s, hti: null, mti: null, mtia: null });
const day = (at: string, operator_s: number, machine_s: number): Autonomy["days"][number] => ({ at, share: share(operator_s, machine_s) });
const session = (epoch: number, more: Partial<StoredSession> = {}): StoredSession => ({
  epoch, holder: "demo", action: null, task: null, outcome: null, intervened: false, started_at: "2026-03-01T10:00:00Z", ended_at: null,
  share: share(0, 0), recorded: false, ...more,
});
const NOON = Date.parse("2026-03-15T12:00:00Z");
const at = (time: string): number => Date.parse(time);

describe("bars over time", () => {
  it.each<[Span, string, number]>([
    ["day", "2026-03-15T00:00:00Z", 1],
    ["week", "2026-03-09T00:00:00Z", 7],
    ["month", "2026-02-14T00:00:00Z", 30],
    ["year", "2025-03-17T00:00:00Z", 52],
  ])("of one %s begin with a whole day and end with today", (span, first, count) => {
    const bars = barsOf([], span, NOON);
    expect([startOf(span, NOON), bars.length, bars[0]?.startMs]).toEqual([at(first), count, at(first)]);
    expect(bars.at(-1)?.lastDayMs).toBe(at("2026-03-15T00:00:00Z"));
    expect(count * SPANS[span].daysPerBar).toBe(SPANS[span].days);
  });

  it("contain each day once, and nothing from other days", () => {
    const days = [day("2026-03-08T00:00:00Z", 100, 100), day("2026-03-09T00:00:00Z", 1, 2), day("2026-03-15T00:00:00Z", 3, 0), day("2026-03-16T00:00:00Z", 9, 9)];
    const bars = barsOf(days, "week", NOON);
    expect(bars.map(({ operatorS, machineS }) => [operatorS, machineS])).toEqual([[1, 2], [0, 0], [0, 0], [0, 0], [0, 0], [0, 0], [3, 0]]);
  });

  it("of a year sum the days of a week", () => {
    const bars = barsOf([day("2026-03-09T00:00:00Z", 1, 0), day("2026-03-15T00:00:00Z", 1, 4)], "year", NOON);
    expect(bars.at(-1)).toMatchObject({ startMs: at("2026-03-09T00:00:00Z"), operatorS: 2, machineS: 4 });
    expect(bars.slice(0, -1).every(({ operatorS, machineS }) => operatorS + machineS === 0)).toBe(true);
  });

  describe.each(["Pacific/Auckland", "America/Los_Angeles"])("in %s", (zone) => {
    beforeEach(() => {
      vi.stubEnv("TZ", zone);
      vi.resetModules(); // formats of dates keep the time zone in which they were created
    });
    afterEach(() => vi.unstubAllEnvs());

    it("are days of UTC, also where the local date differs", async () => {
      const { format } = await import("../../../src/shared/i18n/format");
      for (const now of ["2026-03-15T00:00:00Z", "2026-03-15T23:59:59Z"]) {
        expect(new Date(at(now)).getTimezoneOffset()).not.toBe(0);
        const [bar] = barsOf([day("2026-03-15T00:00:00Z", 1, 1)], "day", at(now));
        expect(bar).toMatchObject({ startMs: at("2026-03-15T00:00:00Z"), operatorS: 1 });
        expect(format.utcDay(bar?.startMs ?? NaN)).toBe("15 Mar");
      }
    });
  });
});

describe("figures", () => {
  it.each([
    [0, "0.0 s"], [0.04, "< 0.1 s"], [3.21, "3.2 s"], [9.96, "10 s"], [59.4, "59 s"], [59.6, "1 min 0 s"], [200, "3 min 20 s"], [3599.7, "1 h 0 min"],
    [7500, "2 h 5 min"], [7199, "2 h 0 min"],
  ])("show %d seconds as %s", (seconds, text) => expect(durationText(seconds)).toBe(text));

  it.each([
    [0, "0 %"], [0.0001, "< 0.1 %"], [0.25, "25 %"], [1 / 3, "33.3 %"], [0.9999, "> 99.9 %"], [1, "100 %"],
  ])("show the share %d as %s", (value, text) => expect(shareText(value)).toBe(text));

  it.each([
    [0, "0"], [0.001, "< 0.01"], [1 / 3, "0.333"], [1, "1"], [12.34, "12.3"], [4321.5, "4322"],
  ])("show the ratio %d as %s", (value, text) => expect(ratioText(value)).toBe(text));

  it("are the metrics of the motion, without MTIA if no operator moved the robot, and none without motion", () => {
    expect(metricsOf({ operator_s: 3, machine_s: 1, hti: 0.75, mti: 0.25, mtia: 1 / 3 })).toEqual({ hti: "75 %", mti: "25 %", mtia: "0.333" });
    expect(metricsOf({ operator_s: 3, machine_s: 0, hti: 1, mti: 0, mtia: 0 })).toEqual({ hti: "100 %", mti: "0 %", mtia: "0" });
    expect(metricsOf({ operator_s: 0, machine_s: 2, hti: 0, mti: 1, mtia: null })).toEqual({ hti: "0 %", mti: "100 %", mtia: null });
    expect(metricsOf(share(0, 0))).toBeNull();
  });

  it("measure a session until its end, or until now", () => {
    expect(secondsOf(session(1, { ended_at: "2026-03-01T10:00:30Z" }), NOON)).toBe(30);
    expect(secondsOf(session(1), at("2026-03-01T10:01:00Z"))).toBe(60);
    expect(secondsOf(session(1), at("2026-03-01T09:59:00Z"))).toBe(0);
    expect(secondsOf(session(1, { started_at: null }), NOON)).toBeNull();
  });
});

describe("the list of sessions", () => {
  const ROUTE = `GET /devices/${DEVICE}/sessions`;
  let server: FakeServer;
  let history: SessionHistory;
  let newest: number;

  beforeEach(() => {
    server = new FakeServer();
    history = new SessionHistory(server.api, DEVICE);
    newest = 50;
    // The cursor is the epoch of the next session.
    server.on(ROUTE, ({ query }) => {
      const first = Number(query.get("cursor") ?? newest);
      const epochs = Array.from({ length: Math.min(first, Number(query.get("limit"))) }, (_, index) => first - index);
      const next = first - epochs.length;
      return ok({ items: epochs.map((epoch) => session(epoch)), cursor: next === 0 ? null : String(next) });
    });
  });
  afterEach(() => void vi.unstubAllGlobals());

  const epochs = (): number[] => (history.sessions.value ?? []).map(({ epoch }) => epoch);
  const down = (first: number, last: number): number[] => Array.from({ length: first - last + 1 }, (_, index) => first - index);

  it("is unknown before the first response, and empty for a robot without sessions", async () => {
    newest = 0;
    expect(history.sessions.value).toBeNull();
    await history.refresh();
    expect([history.sessions.value, history.more.value]).toEqual([[], false]);
  });

  it("is read page by page to its end", async () => {
    await history.refresh();
    expect([epochs(), history.more.value]).toEqual([down(50, 31), true]);
    await history.loadOlder();
    await history.loadOlder();
    expect([epochs(), history.more.value]).toEqual([down(50, 1), false]);
  });

  it("keeps older pages and the place in them when new sessions start", async () => {
    await history.refresh();
    await history.loadOlder();
    newest = 53;
    await history.refresh();
    expect(epochs()).toEqual(down(53, 11));
    await history.loadOlder();
    expect([epochs(), history.more.value]).toEqual([down(53, 1), false]);
  });

  it("starts anew without a gap if more sessions have started than one page contains", async () => {
    await history.refresh();
    newest = 71;
    await history.refresh();
    expect(epochs()).toEqual(down(71, 52));
    await history.loadOlder();
    expect(epochs()).toEqual(down(71, 32));
  });

  it("shows a session's new figures", async () => {
    await history.refresh();
    server.on(ROUTE, ok({ items: [session(50, { ended_at: "2026-03-01T10:00:30Z" }), ...down(49, 31).map((epoch) => session(epoch))], cursor: "30" }));
    await history.refresh();
    expect([epochs(), history.sessions.value?.[0]?.ended_at]).toEqual([down(50, 31), "2026-03-01T10:00:30Z"]);
  });

  it("keeps its sessions after an error, and continues afterwards", async () => {
    await history.refresh();
    server.on(ROUTE, problem(503, "busy", "Later, please."));
    await history.loadOlder();
    expect([epochs(), history.error.value, history.busy.value, history.more.value]).toEqual([down(50, 31), "Later, please.", false, true]);
    server.on(ROUTE, ok({ items: [session(30)], cursor: null }));
    await history.loadOlder();
    expect([epochs(), history.error.value, history.more.value]).toEqual([down(50, 30), "", false]);
  });
});
