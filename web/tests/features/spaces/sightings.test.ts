import { describe, expect, it } from "vitest";
import { currentSightings, SightingTimer } from "../../../src/features/spaces/model/sightings";

describe("a sighting on the floor plan", () => {
  it("is drawn for three periods and one second", () => {
    const seen = new SightingTimer(2).arrived({ echoes: [[1, 2]] }, 1_000);
    expect(currentSightings([seen], 3_500)).toEqual([expect.objectContaining({ echoes: [[1, 2]], people: [] })]);
    expect(currentSightings([seen], 3_501)).toEqual([]);
  });

  it("is drawn until the next one while an agent with a high load sends a quarter of the rate", () => {
    const timer = new SightingTimer(2);
    const [, , third] = [1_000, 3_000, 5_000].map((at) => timer.arrived({}, at));
    if (third === undefined) throw new Error("no third sighting");
    expect(currentSightings([third], 5_000 + 7_000)).toHaveLength(1);
    expect(currentSightings([third], 5_000 + 7_001)).toHaveLength(0);
  });
});
