/** What the health page says where the device and the cloud do not agree, and what is measured of what. */
import type { Fault, Watched } from "../../../src/shared/api/health";
import { describe, expect, it } from "vitest";
import { intervalAround, healthNow, openCount, standings, watchedQuantity, worstFirst } from "../../../src/features/health/model/health";

const fault = (code: string, more: Partial<Fault> = {}): Fault => ({
  id: code,
  code,
  state: "raised",
  source: "device",
  kind: "reported",
  severity: "error",
  message: code,
  stream: "",
  field: "",
  value: null,
  baseline: null,
  limit: null,
  raised_at: "2026-01-01T12:00:00.000Z",
  acknowledged_at: null,
  acknowledged_by: "",
  cleared_at: null,
  count: 1,
  worsened: 0,
  ...more,
});
const told = (code: string) => ({ code, message: code, since_ms: 1 });

describe("a fault that is open", () => {
  it("is the same where device and cloud name the same code", () => {
    expect(standings([fault("driver")], [told("driver")])).toMatchObject([{ agreement: "same", told: { code: "driver" } }]);
  });

  it("is shown before the cloud has stored it, first", () => {
    const found = standings([fault("health.x", { source: "detector" })], [told("driver")]);
    expect(found.map(({ agreement }) => agreement)).toEqual(["unstored", "same"]);
    expect(found[0]?.stored).toBeNull();
  });

  it("is said to have ended at the device while the cloud still has it", () => {
    expect(standings([fault("driver")], [])[0]?.agreement).toBe("ended");
  });

  it("is said to be the cloud's record where the device cannot be heard", () => {
    const found = standings([fault("driver"), fault("silent", { source: "cloud" })], null);
    expect(found.map(({ agreement }) => agreement)).toEqual(["unheard", "same"]);
  });

  it("counts once, by the device's own word where that is heard", () => {
    const open = [fault("driver"), fault("health.x", { source: "detector" })];
    expect([openCount(open, [told("driver")]), openCount(open, []), openCount(open, null), openCount(null, [told("a")])]).toEqual([2, 1, 2, 1]);
    expect(openCount(null, null)).toBe(0);
  });

  it("makes a device ill at once, and one that is not heard is not called well", () => {
    expect(healthNow("ok", [told("driver")], "online")).toBe("fault");
    expect([healthNow("ok", [], "online"), healthNow("ok", null, "stale"), healthNow("warning", null, "offline")]).toEqual([
      "ok",
      "unknown",
      "warning",
    ]);
  });

  it("has no end to what happened around it while it lasts", () => {
    const at = Date.parse("2026-01-01T12:00:00Z");
    expect(intervalAround(fault("a"))).toEqual([at - 60_000, Infinity]);
    expect(intervalAround(fault("a", { cleared_at: "2026-01-01T12:10:00Z" }))[1]).toBe(at + 11 * 60_000);
  });
});

const watched = (more: Partial<Watched>): Watched => ({
  stream: "health",
  field: "temperature_c.elbow",
  label: "Joint temperature",
  unit: "°C",
  advice: "Let it rest.",
  value: 30,
  baseline: 30,
  usual_low: null,
  usual_high: null,
  warning_low: null,
  warning_high: 70,
  low: null,
  high: 80,
  slope_per_s: null,
  limit_in_s: null,
  findings: [],
  updated_at: "2026-01-01T12:00:00Z",
  ...more,
});

describe("a watched field", () => {
  it("goes by its own label and part, in its own unit, with its limits", () => {
    const found = watchedQuantity(watched({}), null);
    expect(found).toMatchObject({ label: "Joint temperature · elbow", unit: "°C", judged: { warning_high: 70, high: 80, advice: "Let it rest." } });
    expect(found.shown(30)).toBe(30);
  });

  it("of angles is shown in degrees", () => {
    const found = watchedQuantity(watched({ field: "following_error_rad.wrist_1", label: "Following error", unit: "rad", high: 0.1 }), null);
    expect(found).toMatchObject({ label: "Following error · wrist 1", unit: "°" });
    expect(found.shown(Math.PI)).toBeCloseTo(180);
  });

  it("that is not listed is named by its field, without limits", () => {
    const found = watchedQuantity(watched({ field: "battery_v", label: "battery_v", unit: "", advice: "", high: null, warning_high: null }), null);
    expect(found).toMatchObject({ label: "Battery", unit: "V", judged: null });
  });

  it("with a finding stands first", () => {
    const found = worstFirst([watched({ field: "a" }), watched({ field: "b", findings: ["level"] })]);
    expect(found.map(({ field }) => field)).toEqual(["b", "a"]);
  });
});
