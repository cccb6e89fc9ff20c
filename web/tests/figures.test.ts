import { describe, expect, it } from "vitest";
import { degrees, radians } from "../src/shared/lib/angles";
import { RecentTelemetry, SPAN_MS } from "../src/features/twin/model/recent-telemetry";
import type { KnownTelemetry } from "../src/shared/mqtt/parse-messages";
import { percentile, RoundTrip } from "../src/features/latency/model/round-trip";
import { signInFailure, signInToken } from "../src/features/account/model/session";
import { deviceTopics, matches } from "../src/shared/mqtt/topics";
import { format } from "../src/shared/i18n/format";

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

describe("the history behind the plot", () => {
  const message = (position: number): KnownTelemetry =>
    ({ position_rad: [position, -position], velocity_rad_s: [0, 0], effort_nm: [0, 0] }) as unknown as KnownTelemetry;

  it("has one column of times and one for each joint asked for", () => {
    const history = new RecentTelemetry();
    history.add(message(1), 1_000);
    history.add(message(2), 1_050);
    expect(history.columns("position_rad", [1], 2_050)).toEqual([
      [-1.05, -1],
      [-1, -2],
    ]);
  });

  it("breaks the line where nothing was heard", () => {
    const history = new RecentTelemetry();
    history.add(message(1), 0);
    history.add(message(2), 5_000);
    expect(history.columns("position_rad", [0], 5_000)[1]).toEqual([1, null, 2]);
  });

  it("forgets what is older than it shows", () => {
    const history = new RecentTelemetry();
    for (let at = 0; at < 100_000; at += 20) history.add(message(at), at);
    const [times] = history.columns("position_rad", [0], 100_000);
    expect(times[0]).toBeGreaterThanOrEqual(-SPAN_MS / 1000);
    expect(times.length).toBeLessThanOrEqual(SPAN_MS / 20 + 1);
    expect(history.columns("position_rad", [0], 900_000)[0]).toEqual([]);
  });
});

describe("small things", () => {
  it("degrees and radians undo each other", () => {
    expect(degrees(radians(12.5))).toBeCloseTo(12.5);
  });

  it("a value that rounds to nought has no sign", () => {
    expect(format.degrees(-0.04)).toBe("0.0°");
    expect(format.degrees(-0.06)).toBe("-0.1°");
  });

  it("ages are told in the largest fitting unit", () => {
    expect([0, 59_000, 61_000, 3_700_000, 200_000_000].map(format.age)).toEqual([
      "just now",
      "59 s ago",
      "1 min ago",
      "1 h ago",
      "2 days ago",
    ]);
  });

  it("why signing in elsewhere failed is a code, and nothing else", () => {
    expect(signInFailure("#sign-in-failed=oidc-expired")).toBe("oidc-expired");
    for (const hash of ["", "#/", "#sign-in-failed=", "#sign-in-failed=<b>"]) expect(signInFailure(hash)).toBeNull();
  });

  it("a sign-in token is taken from its own fragment only", () => {
    expect(signInToken("#sign-in=abc-_%2B")).toBe("abc-_+");
    for (const hash of ["", "#/", "#sign-in=", "#x&sign-in=abc", "#sign-in=%"]) expect(signInToken(hash)).toBeNull();
  });

  it("topics are those of the contract", () => {
    const topics = deviceTopics("ts/v1/lab/a1/arm");
    expect(topics.conn).toBe("ts/v1/lab/a1/conn");
    expect(topics.ctl(5)).toBe("ts/v1/lab/a1/arm/ctl/5");
  });

  it.each([
    ["a/+/c", "a/b/c", true],
    ["a/+", "a/b/c", false],
    ["a/#", "a/b/c", true],
    ["a/b", "a/b/c", false],
    ["a/b/c", "a/b", false],
  ])("the filter %s and the topic %s match: %s", (filter, topic, wanted) => {
    expect(matches(filter, topic)).toBe(wanted);
  });
});
