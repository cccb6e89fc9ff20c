import { describe, expect, it } from "vitest";
import { healthNow, intervalAround, openCount, compareFaults, watchedQuantity, worstFirst } from "../../../src/features/health/model/health";
import type { Fault, MonitoredField } from "../../../src/shared/api/health";

const fault = (code: string, more: Partial<Fault> = {}): Fault => ({
  id: code, code, state: "raised", source: "device", kind: "reported", severity: "error", message: code, stream: "",
  field: "", value: null, baseline: null, limit: null, raised_at: "2026-01-01T12:00:00.000Z", acknowledged_at: null,
  acknowledged_by: "", cleared_at: null, count: 1, worsened: 0, occurrences: 1, last_seen_at: null, ...more,
});
const reported = (code: string) => ({ code, message: code, since_ms: 1, count: 1, last_ms: 1 });
const driver = fault("driver");
const detected = fault("health.x", { source: "detector" });

describe("an open fault", () => {
  it.each([
    ["both report it", [driver], [reported("driver")], ["same"]],
    ["the cloud has not stored it yet", [detected], [reported("driver")], ["unstored", "same"]],
    ["it has ended at the device", [driver], [], ["ended"]],
    ["the device is unreachable", [driver, fault("silent", { source: "cloud" })], null, ["unreachable", "same"]],
  ])("names its source when %s", (_, stored, reported, agreement) => {
    expect(compareFaults(stored, reported).map(({ agreement: actual }) => actual)).toEqual(agreement);
  });

  it("counts once, by the device's report if it is reachable", () => {
    const stored = [driver, detected];
    const counts = [[stored, [reported("driver")]], [stored, []], [stored, null], [null, [reported("a")]], [null, null]] as const;
    expect(counts.map(([open, reported]) => openCount(open, reported))).toEqual([2, 1, 2, 1, 0]);
  });

  it("is shown immediately, and an unreachable device is not shown as healthy", () => {
    expect(healthNow("ok", [reported("driver")], "online")).toBe("fault");
    expect(healthNow("ok", [], "online")).toBe("ok");
    expect(healthNow("ok", null, "stale")).toBe("unknown");
    expect(healthNow("warning", null, "offline")).toBe("warning");
  });

  it("has events around it from a minute before it to a minute after its end", () => {
    const at = Date.parse("2026-01-01T12:00:00Z");
    expect(intervalAround(driver)).toEqual([at - 60_000, Infinity]);
    expect(intervalAround(fault("a", { cleared_at: "2026-01-01T12:10:00Z" }))[1]).toBe(at + 11 * 60_000);
  });
});

const watched = (more: Partial<MonitoredField>): MonitoredField => ({
  stream: "health", field: "temperature_c.elbow", label: "Joint temperature", unit: "°C", advice: "Let it rest.",
  value: 30, baseline: 30, usual_low: null, usual_high: null, warning_low: null, warning_high: 70, low: null, high: 80,
  slope_per_s: null, limit_earliest_s: null, limit_latest_s: null, findings: [], updated_at: "2026-01-01T12:00:00Z", ...more,
});

describe("a watched field", () => {
  it.each([
    [{}, { label: "Joint temperature · elbow", unit: "°C", limits: { warning_high: 70, high: 80, advice: "Let it rest." } }, 1],
    [{ field: "following_error_rad.wrist_1", label: "Following error", unit: "rad" }, { label: "Following error · wrist 1", unit: "°" }, 180 / Math.PI],
    [{ field: "battery_v", label: "battery_v", unit: "", advice: "", high: null, warning_high: null }, { label: "Battery", unit: "V", limits: null }, 1],
  ])("has a label, a unit and limits: %o", (more, expected, factor) => {
    const quantity = watchedQuantity(watched(more), null);
    expect(quantity).toMatchObject(expected);
    expect(quantity.toDisplay(2)).toBeCloseTo(2 * factor);
  });

  it("with a finding comes first", () => {
    const sorted = worstFirst([watched({ field: "a" }), watched({ field: "b", findings: ["level"] })]);
    expect(sorted.map(({ field }) => field)).toEqual(["b", "a"]);
  });
});
