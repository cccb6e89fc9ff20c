import { describe, expect, it } from "vitest";
import { reducedRates } from "../../../src/features/devices/model/rates";

const described = {
  streams: [{ name: "joints", rate_hz: 20 }, { name: "power", rate_hz: 1 }],
  cameras: [{ name: "front", rate_hz: 10 }],
};

describe("rates of a device", () => {
  it("lists what is slower than configured while the agent reduces work", () => {
    const rates = { "tele/joints": 8, "tele/power": 0.9, "cam/front": 2.4 };
    expect(reducedRates(described, { load: 3, rates_hz: rates })).toEqual([
      { name: "joints", measuredHz: 8, configuredHz: 20 },
      { name: "front", measuredHz: 2.4, configuredHz: 10 },
    ]);
  });

  it("lists nothing without overload, and nothing that is not measured", () => {
    expect(reducedRates(described, { load: 0, rates_hz: { "cam/front": 1 } })).toEqual([]);
    expect(reducedRates(described, { load: 1, rates_hz: {} })).toEqual([]);
    expect(reducedRates(null, null)).toEqual([]);
  });
});
