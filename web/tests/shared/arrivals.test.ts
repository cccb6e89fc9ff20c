import { describe, expect, it } from "vitest";
import { Arrivals, lateAfterMs } from "../../src/shared/lib/arrivals";

/** Arrivals after these intervals [ms]. */
function after(...intervals: number[]): Arrivals {
  const arrivals = new Arrivals();
  let at = 5_000;
  arrivals.add(at);
  for (const interval of intervals) arrivals.add((at += interval));
  return arrivals;
}

describe("a stream", () => {
  it("is late after three periods and one second; the longer of the declared and the observed period counts", () => {
    expect(lateAfterMs(2, null)).toBe(2_500);
    expect(lateAfterMs(2, 2_000)).toBe(7_000);
    expect(lateAfterMs(2, 100)).toBe(2_500);
  });

  it("has an observed period from the third arrival", () => {
    expect(after().everyMs).toBeNull();
    expect(after(500).everyMs).toBeNull();
    expect(after(2_000, 2_100).everyMs).toBe(2_000);
  });

  it("does not count one interruption as its period", () => {
    expect(after(500, 500, 60_000).everyMs).toBe(500);
    expect(after(500, 500, 60_000, 500).everyMs).toBe(500);
  });

  it("has the mean rate of three seconds", () => {
    const arrivals = after(...Array.from({ length: 40 }, () => 100));
    expect(arrivals.rateHz(5_000 + 4_000)).toBeCloseTo(10, 0);
    expect(after(700, 700, 700).rateHz(5_000 + 2_100)).toBeCloseTo(1.4, 1);
    expect(after().rateHz(5_000)).toBe(0);
  });
});
