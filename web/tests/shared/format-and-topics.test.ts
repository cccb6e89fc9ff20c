import { describe, expect, it } from "vitest";
import { degrees, radians } from "../../src/shared/lib/angles";
import { deviceTopics, matches } from "../../src/shared/mqtt/topics";
import { format } from "../../src/shared/i18n/format";

describe("formats", () => {
  it("have no sign for zero, and the largest fitting unit for ages", () => {
    expect(degrees(radians(12.5))).toBeCloseTo(12.5);
    expect([-0.04, -0.06].map(format.degrees)).toEqual(["0.0°", "-0.1°"]);
    const ages = [0, 59_000, 61_000, 3_700_000, 200_000_000].map(format.age);
    expect(ages).toEqual(["just now", "59 s ago", "1 min ago", "1 h ago", "2 days ago"]);
  });

  it("show a size in its largest fitting unit", () => {
    const sizes = [0, 1, 999_000, 1_250_000, 20_000_000_000].map(format.fileSize);
    expect(sizes).toEqual(["0 kB", "1 kB", "999 kB", "1.3 MB", "20.0 GB"]);
  });
});

describe("topics", () => {
  it("equal those of the contract", () => {
    const topics = deviceTopics("ts/v1/lab/a1/arm");
    expect([topics.conn, topics.ctl(5)]).toEqual(["ts/v1/lab/a1/conn", "ts/v1/lab/a1/arm/ctl/5"]);
  });

  it.each([
    ["a/+/c", "a/b/c", true],
    ["a/+", "a/b/c", false],
    ["a/#", "a/b/c", true],
    ["a/b", "a/b/c", false],
    ["a/b/c", "a/b", false],
  ])("the filter %s and the topic %s match: %s", (filter, topic, expected) => {
    expect(matches(filter, topic)).toBe(expected);
  });
});
