/** What the cards of depth cameras and lidars show as live. */
import { describe, expect, it } from "vitest";
import { depthView, scanView, type LiveStream } from "../../../src/features/sensors/model/live-view";
import type { KnownPeople } from "../../../src/shared/mqtt/sensor-frames";
import { texts } from "../../../src/features/sensors/texts";

const PEOPLE: KnownPeople = { position_m: [0, 0, 1], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], fovy_rad: 1, people: [] };
const NOW = 100_000;

/** A stream whose newest frame has this age [ms]; `null`: it has none. */
function stream<T>(value: T, ageMs: number | null, rateHz: number, everyMs: number | null = null): LiveStream<T> {
  return { latest: ageMs === null ? null : { value, sequence: 1, at: NOW - ageMs, everyMs, rateHz }, rateHz };
}
const depth = (ageMs: number | null, everyMs: number | null = null): LiveStream<number> => stream(0, ageMs, 5, everyMs);
const people = (ageMs: number | null): LiveStream<KnownPeople> => stream(PEOPLE, ageMs, 10);

describe("a live depth image", () => {
  it("has the people of the same moment only", () => {
    expect(depthView(true, depth(100), people(1_200), NOW)).toEqual({ stalled: false, overlay: PEOPLE });
    // Three periods of 0.1 s and one second.
    expect(depthView(true, depth(100), people(1_400), NOW)).toEqual({ stalled: false, overlay: null });
    expect(depthView(true, depth(100), people(null), NOW).overlay).toBeNull();
  });

  it("has no people while it is late, missing or not live", () => {
    expect(depthView(true, depth(1_700), people(100), NOW)).toEqual({ stalled: true, overlay: null });
    expect(depthView(true, depth(null), people(100), NOW)).toEqual({ stalled: false, overlay: null });
    expect(depthView(false, depth(100), people(100), NOW)).toEqual({ stalled: false, overlay: null });
  });

  it("is not late while an agent with a high load sends less often", () => {
    expect(depthView(true, depth(1_700, 800), null, NOW).stalled).toBe(false);
    expect(depthView(true, depth(3_500, 800), null, NOW).stalled).toBe(true);
  });

  it("is not necessary for the people of a tracker without images", () => {
    expect(depthView(true, null, people(100), NOW)).toEqual({ stalled: false, overlay: PEOPLE });
    expect(depthView(true, null, people(1_400), NOW)).toEqual({ stalled: true, overlay: null });
    expect(depthView(true, null, null, NOW)).toEqual({ stalled: false, overlay: null });
  });
});

describe("a lidar view", () => {
  const scan = (ageMs: number | null, everyMs: number | null = null): LiveStream<number> => stream(0, ageMs, 5, everyMs);

  it("shows a captured scan as current, with or without other streams", () => {
    expect(scanView(true, scan(60_000), null, NOW)).toEqual({ dots: "captured", old: false });
    expect(scanView(true, null, null, NOW)).toEqual({ dots: "captured", old: false });
    expect(scanView(true, scan(null), true, NOW)).toEqual({ dots: "captured", old: true });
  });

  it("states why there are no dots when live scans stop, while sectors continue", () => {
    expect(scanView(false, scan(100), false, NOW)).toEqual({ dots: "live", old: false });
    expect(scanView(false, scan(1_700), false, NOW)).toEqual({ dots: "stalled", old: false });
    expect(scanView(false, scan(1_700), null, NOW)).toEqual({ dots: "stalled", old: true });
    expect(scanView(false, scan(null), false, NOW)).toEqual({ dots: "waiting", old: false });
    expect(scanView(false, null, false, NOW)).toEqual({ dots: "none", old: false });
  });

  it("is live while an agent with a high load sends less often", () => {
    expect(scanView(false, scan(3_000, 800), null, NOW).dots).toBe("live");
  });

  it("does not claim to show all beams: live scans can be reduced", () => {
    expect(texts.scan.beams(360, "4.0")).toBe("Dots: 360 beams, live, 4.0 Hz.");
  });
});
