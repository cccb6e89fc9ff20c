import { describe, expect, it } from "vitest";
import { percentile, RoundTrip } from "../../../src/features/latency/model/round-trip";

describe("the round trip", () => {
  it("counts each setpoint once, at the first telemetry that names it", () => {
    const trip = new RoundTrip();
    trip.seen(1, 100, 120);
    trip.seen(1, 100, 170);
    trip.seen(3, 200, 210);
    trip.seen(2, 150, 260);
    expect(trip.figures.value).toEqual({ latestMs: 10, medianMs: 10, p95Ms: 20, samples: 2 });
  });

  it("takes no answer that came before the question", () => {
    const trip = new RoundTrip();
    trip.seen(1, 500, 400);
    expect(trip.figures.value).toBeNull();
  });

  it("looks at the newest samples only, and at none of an older lease", () => {
    const trip = new RoundTrip(10);
    for (let index = 1; index <= 30; index += 1) trip.seen(index, 0, index);
    expect(trip.figures.value).toMatchObject({ samples: 10, medianMs: 25, p95Ms: 30 });
    trip.restart();
    expect(trip.figures.value).toBeNull();
    trip.seen(1, 0, 5);
    expect(trip.figures.value?.samples).toBe(1);
  });

  it("takes percentiles by nearest rank", () => {
    const values = Array.from({ length: 100 }, (_, index) => index + 1);
    expect([percentile(values, 0.5), percentile(values, 0.95), percentile([4], 0.95)]).toEqual([50, 95, 4]);
  });
});
