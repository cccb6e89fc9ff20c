import { describe, expect, it } from "vitest";
import { degrees, radians } from "../../src/shared/lib/angles";
import { deviceTopics, matches } from "../../src/shared/mqtt/topics";
import { format } from "../../src/shared/i18n/format";

describe("formats and topics", () => {
  it("converts between degrees and radians", () => {
    expect(degrees(radians(12.5))).toBeCloseTo(12.5);
  });

  it("shows no sign for a value that rounds to zero", () => {
    expect(format.degrees(-0.04)).toBe("0.0°");
    expect(format.degrees(-0.06)).toBe("-0.1°");
  });

  it("ages use the largest fitting unit", () => {
    expect([0, 59_000, 61_000, 3_700_000, 200_000_000].map(format.age)).toEqual([
      "just now",
      "59 s ago",
      "1 min ago",
      "1 h ago",
      "2 days ago",
    ]);
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
