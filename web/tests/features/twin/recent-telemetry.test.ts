import { expect, it } from "vitest";
import { RecentTelemetry, SPAN_MS } from "../../../src/features/twin/model/recent-telemetry";
import { isVisibleChange } from "../../../src/features/twin/model/visible-change";
import type { KnownTelemetry } from "../../../src/shared/mqtt/parse-messages";

const message = (position: number): KnownTelemetry =>
  ({ position_rad: [position, -position], velocity_rad_s: [0, 0], effort_nm: [0, 0] }) as unknown as KnownTelemetry;

it("plots one column of times and one for each requested joint, with a gap after a pause", () => {
  const history = new RecentTelemetry();
  history.add(message(1), 1_000);
  history.add(message(2), 1_050);
  expect(history.columns("position_rad", [1], 2_050)).toEqual([[-1.05, -1], [-1, -2]]);
  history.add(message(3), 6_000);
  expect(history.columns("position_rad", [0], 6_000)[1]).toEqual([1, 2, null, 3]);
});

it("keeps telemetry only for the displayed time span", () => {
  const history = new RecentTelemetry();
  for (let at = 0; at < 100_000; at += 20) history.add(message(at), at);
  const [times] = history.columns("position_rad", [0], 100_000);
  expect(times[0]).toBeGreaterThanOrEqual(-SPAN_MS / 1000);
  expect(times.length).toBeLessThanOrEqual(SPAN_MS / 20 + 1);
  expect(history.columns("position_rad", [0], 900_000)[0]).toEqual([]);
});

it.each<[expected: boolean, drawn: Record<string, number> | null, next: Record<string, number> | null, scale: number]>([
  [false, { shoulder: 0.1, elbow: 0.2 }, { shoulder: 0.1, elbow: 0.2 }, 1],
  [false, { shoulder: 0.1, elbow: 0.2 }, { shoulder: 0.102, elbow: 0.2 }, 1],
  [true, { shoulder: 0.1, elbow: 0.2 }, { shoulder: 0.102, elbow: 0.198 }, 1],
  [true, { shoulder: 0.1, elbow: 0.2 }, { shoulder: 0.103, elbow: 0.2 }, 1],
  [true, { shoulder: 0.1, elbow: 0.2 }, { shoulder: 0.102, elbow: 0.2 }, 2],
  [true, null, { shoulder: 0 }, 1],
  [true, { shoulder: 0 }, null, 1],
  [false, null, null, 1],
  [true, {}, { shoulder: 0 }, 1],
])("redraws (%s) from %o to %o at scale %s if a part of 2 m moves by half a pixel", (expected, drawn, next, scale) => {
  expect(isVisibleChange(drawn, next, 2, 100 * scale)).toBe(expected);
});
