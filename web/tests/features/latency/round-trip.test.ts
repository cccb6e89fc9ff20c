import { describe, expect, it } from "vitest";
import { percentile, RoundTrip } from "../../../src/features/latency/model/round-trip";

describe("the round trip", () => {
  it("counts each setpoint once, at the first telemetry that echoes it, and no earlier telemetry", () => {
    const trip = new RoundTrip();
    trip.add(1, 500, 400);
    expect(trip.figures.value).toBeNull();
    trip.restart();
    trip.add(1, 100, 120);
    trip.add(1, 100, 170);
    trip.add(3, 200, 210);
    trip.add(2, 150, 260);
    expect(trip.figures.value).toEqual({ latestMs: 10, medianMs: 10, p95Ms: 20, samples: 2 });
  });

  it("uses the newest samples of this lease only, with percentiles by nearest rank", () => {
    const trip = new RoundTrip(10);
    for (let index = 1; index <= 30; index += 1) trip.add(index, 0, index);
    expect(trip.figures.value).toMatchObject({ samples: 10, medianMs: 25, p95Ms: 30 });
    trip.restart();
    trip.add(1, 0, 5);
    expect(trip.figures.value?.samples).toBe(1);
    expect(percentile([4], 0.95)).toBe(4);
  });
});
