import { describe, expect, it } from "vitest";
import { expectsMore, plotColumns, type TimelineEvent } from "../../../../src/features/autonomy/model/recording";
import { type Overview, readOverview } from "../../../../src/features/autonomy/model/recording/overview";
import { gapsOf, type LoadedOverview, partAt, timelineOf } from "../../../../src/features/autonomy/model/recording/timeline";
import { degrees } from "../../../../src/shared/lib/angles";
import type { RecordedSession } from "../../../../src/shared/api/recordings";
import { recordedSession, writeOverview } from "../../../support/recordings";

const overview = (...parameters: Parameters<typeof writeOverview>): Overview => readOverview(writeOverview(...parameters));
const loaded = (...entries: [number, LoadedOverview][]): Map<number, LoadedOverview> => new Map(entries);

describe("the time axis", () => {
  it("has the segments in order of time, in any order of the list and of loading", () => {
    const timeline = timelineOf(recordedSession([2, 0, 1]), loaded([2, overview(120, 150)], [0, overview(0, 60)], [1, overview(60, 120)]));
    expect(timeline.parts.map(({ info, start_s, end_s }) => [info.segment, start_s, Math.round(end_s)])).toEqual([[0, 0, 60], [1, 60, 120], [2, 120, 150]]);
    expect([timeline.duration_s, timeline.joints]).toEqual([150, ["yaw", "pitch"]]);
  });

  it("has a span for each source, which ends at a gap", () => {
    const source = (time: number): string => (time < 10 ? "operator" : "movement");
    const { spans } = timelineOf(recordedSession([0]), loaded([0, overview(0, 60, source, [30, 40])]));
    expect(spans.map((span) => [span.source, Number(span.start_s.toFixed(3)), Number(span.end_s.toFixed(3))])).toEqual([
      ["operator", 0, 10],
      ["movement", 10, 30],
      ["movement", 40, 60],
    ]);
  });

  it("has no span at missing segments", () => {
    const { spans } = timelineOf(recordedSession([0, 3]), loaded([0, overview(0, 60)], [3, overview(180, 240)]));
    expect(spans.map(({ start_s, end_s }) => [start_s, Math.round(end_s)])).toEqual([[0, 60], [180, 240]]);
  });

  it("has the times of the list for parts that are not loaded or failed", () => {
    const timeline = timelineOf(recordedSession([0, 1, 2]), loaded([0, overview(0, 60)], [1, "The store responded with status 500."]));
    expect(timeline.parts.map(({ start_s, end_s }) => [start_s, Math.round(end_s)])).toEqual([[0, 60], [60, 120], [120, 180]]);
    expect(timeline.parts.map(({ overview: found }) => typeof found)).toEqual(["object", "string", "object"]);
    expect(timeline.spans.length).toBe(1);
  });

  it("rejects a part with other joints", () => {
    const other = { ...overview(60, 120), joints: ["elbow", "wrist"] };
    const { parts } = timelineOf(recordedSession([0, 1]), loaded([0, overview(0, 60)], [1, other]));
    expect(parts[1]?.overview).toBe("The segment has other joints than the first one.");
  });

  it("is empty for a session without a recording", () => {
    expect(timelineOf({ ...recordedSession([]), recording: null }, loaded())).toMatchObject({ parts: [], duration_s: 0 });
  });

  it("finds the part of a time", () => {
    const timeline = timelineOf(recordedSession([0, 1]), loaded([0, overview(0, 60)], [1, overview(60, 120)]));
    expect([partAt(timeline, 59.9)?.info.segment, partAt(timeline, 60)?.info.segment, partAt(timeline, -1)]).toEqual([0, 1, null]);
  });
});

describe("the times without data", () => {
  const gaps = (session: RecordedSession, overviews: Map<number, LoadedOverview>, events: TimelineEvent[] = []): [number, number, string][] =>
    gapsOf(session, timelineOf(session, overviews), events).map(({ start_s, end_s, cause }) => [Math.round(start_s), Math.round(end_s), cause]);

  it("are those of missing segments with their causes", () => {
    const session = recordedSession([0, 2, 4], { missing: [{ segment: 1, cause: "lost" }, { segment: 3, cause: "waiting" }] });
    expect(gaps(session, loaded([0, overview(0, 60)], [2, overview(120, 180)], [4, overview(240, 300)]))).toEqual([[60, 120, "lost"], [180, 240, "waiting"]]);
  });

  it("are inside a segment and between segments, and have the agent's reason", () => {
    const resumed: TimelineEvent = { time_s: 41, kind: "recording-resumed", severity: "info", text: "" };
    const overviews = loaded([0, overview(0, 60, undefined, [30, 40])], [1, overview(70, 120)]);
    expect(gaps(recordedSession([0, 1]), overviews, [resumed])).toEqual([[30, 40, "unrecorded"], [60, 70, "empty"]]);
  });

  it("contain the begin and the end of the session", () => {
    const session = { ...recordedSession([0]), ended_at: "2026-03-01T10:03:00Z", started_at: "2026-03-01T10:00:00Z" };
    expect(gaps(session, loaded([0, overview(20, 60)]))).toEqual([[0, 20, "empty"], [60, 180, "empty"]]);
    expect(gaps({ ...session, ended_at: "2026-03-01T10:01:09Z" }, loaded([0, overview(0, 60)]))).toEqual([]);
  });

  it("are not inside parts that are not loaded", () => {
    expect(gaps(recordedSession([0, 1]), loaded([0, overview(0, 60)]))).toEqual([]);
  });
});

describe("new parts of a recording", () => {
  const ended = (minutes: number): string => new Date(Date.now() - minutes * 60_000).toISOString();

  it.each([
    ["before the session is known", null, true],
    ["while the session lasts", recordedSession([0], { final: false }), true],
    ["shortly after its end", { ...recordedSession([0], { final: false }), ended_at: ended(5) }, true],
    ["shortly after its end without any part", { ...recordedSession([]), recording: null, ended_at: ended(5) }, true],
    ["after the agent has no other part, even if one is missing", { ...recordedSession([1], { complete: false, final: true }), ended_at: ended(5) }, false],
    ["long after its end", { ...recordedSession([0], { final: false }), ended_at: ended(61) }, false],
  ] as const)("%s: %j", (_, session, expected) => {
    expect(expectsMore(session)).toBe(expected);
  });
});

describe("the lines of the plot", () => {
  const first = overview(0, 1);

  it("are measured and applied positions of the chosen joints in degrees", () => {
    const { time_s, solid: measured, dashed: applied } = plotColumns([first], [1]);
    expect([time_s.length, measured.length, applied.length]).toEqual([5, 1, 1]);
    expect(measured[0]?.[1]).toBeCloseTo(degrees(-0.2), 9);
    expect(applied[0]?.[1]).toBeCloseTo(degrees(7), 9);
  });

  it("are not interrupted between samples and segments without a gap", () => {
    expect(plotColumns([first, overview(1, 2)], [0]).solid[0]).not.toContain(null);
  });

  it("end at a gap inside a segment", () => {
    const { time_s, solid: measured } = plotColumns([overview(0, 4, undefined, [1, 3])], [0, 1]);
    const gap = time_s.findIndex((_, index) => measured[0]?.[index] === null);
    expect([time_s[gap - 1], time_s[gap + 1]]).toEqual([0.8, 3]);
    expect(measured[1]?.[gap]).toBeNull();
    expect(measured[0]?.filter((value) => value === null).length).toBe(1);
    expect(time_s).toEqual(time_s.toSorted((one, other) => one - other));
  });

  it("end at a missing segment", () => {
    const { solid: measured } = plotColumns([first, overview(60, 61)], [0]);
    expect(measured[0]?.filter((value) => value === null).length).toBe(1);
  });
});
