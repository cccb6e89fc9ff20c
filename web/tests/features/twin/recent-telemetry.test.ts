import { describe, expect, it } from "vitest";
import { RecentTelemetry, SPAN_MS } from "../../../src/features/twin/model/recent-telemetry";
import type { KnownTelemetry } from "../../../src/shared/mqtt/parse-messages";

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
