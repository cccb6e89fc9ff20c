import { describe, expect, it } from "vitest";
import { groupOf, nearestEvents, type TimelineEvent } from "../../../../src/features/autonomy/model/recording";
import { FileError, readOverview } from "../../../../src/features/autonomy/model/recording/overview";
import { timelineOf } from "../../../../src/features/autonomy/model/recording/timeline";
import { eventsOf } from "../../../../src/features/autonomy/model/recording/timeline-events";
import type { Segment } from "../../../../src/features/autonomy/model/recording/segment";
import { recordedSession, writeOverview } from "../../../support/recordings";

const event = (time_s: number, kind = "motion-held", severity: TimelineEvent["severity"] = "warning"): TimelineEvent => ({ time_s, kind, severity, text: kind });
const overview = (minute: number, more: object) => readOverview(writeOverview(minute * 60, minute * 60 + 60, undefined, undefined, more));
const loaded = (extent: Segment["extent"], kinds: readonly string[]): Pick<Segment, "events" | "extent"> => ({
  extent,
  events: kinds.map((kind, index) => ({ time_s: 60 + index, event: { id: "e", device: "arm", at_ms: 1, kind, severity: "info", message: `the whole text of ${kind}`, data: {} } })),
});

describe("the events of an overview", () => {
  it("are unknown for an older agent, and otherwise as they were written", () => {
    expect(overview(0, {})).toMatchObject({ events: null, events_omitted: 0 });
    expect(overview(0, { events: [event(5)], events_omitted: 3 })).toMatchObject({ events: [event(5)], events_omitted: 3 });
  });

  it.each([{}, [{}], [{ ...event(1), severity: "bad" }], [{ ...event(1), time_s: "1" }]])("that cannot be read (%j) are an error", (events) => {
    expect(() => overview(0, { events })).toThrow(FileError);
  });
});

describe("the events of a session", () => {
  const timeline = timelineOf(
    recordedSession([0, 1, 2]),
    new Map([
      [0, overview(0, { events: [event(5, "stop-latched")], events_omitted: 2 })],
      [1, overview(1, { events: [event(60, "lease-ended")] })],
      [2, overview(2, {})],
    ]),
  );
  const texts = (segments: ReadonlyMap<number, Pick<Segment, "events" | "extent">>) => {
    const { events, omitted, unknown } = eventsOf(timeline, (segment) => segments.get(segment) ?? null);
    return [events.map(({ text }) => text), omitted, unknown];
  };

  it("are known without loading a minute, except of older agents", () => {
    expect(texts(new Map())).toEqual([["stop-latched", "lease-ended"], 2, 1]);
  });

  it("have the whole text after their minute is loaded, without sums", () => {
    expect(texts(new Map([[1, loaded("whole", ["lease-ended", "activity"])]]))).toEqual([["stop-latched", "the whole text of lease-ended"], 2, 1]);
  });

  it("remain those of the overview while only an excerpt is loaded", () => {
    expect(texts(new Map([[1, loaded("excerpt", [])]]))).toEqual([["stop-latched", "lease-ended"], 2, 1]);
    expect(texts(new Map([[2, loaded("excerpt", ["motion-held"])]]))).toEqual([["stop-latched", "lease-ended", "the whole text of motion-held"], 2, 1]);
  });

  it("have a group by their kind", () => {
    const groups = ["stop-reset", "lease-granted", "action-ended", "command-rejected", "driver-failed", "motion-held"].map((kind) => groupOf(event(0, kind)));
    expect(groups).toEqual(["stop", "handover", "command", "command", "fault", "other"]);
    expect(groupOf(event(0, "unforeseen", "error"))).toBe("fault");
  });

  it("are those nearest to the cursor if there are too many", () => {
    const many = [0, 1, 2, 3, 4, 5, 6].map((time) => event(time));
    expect(nearestEvents(many, 1, 5, 4, 3).map(({ time_s }) => time_s)).toEqual([3, 4, 5]);
    expect(nearestEvents(many, 1, 5, 4, 9).length).toBe(5);
  });
});
