/** Behaviours of a robot: labels, recoveries and older agents. */
import { describe, expect, it } from "vitest";
import { behaviourButtons, behaviourLabel } from "../../../src/features/actions/model";

const DESCRIPTION = {
  behaviours: ["Hello", "naoqi-animations--Hey_1", "recovery-power_on"],
  robot_behaviours: [
    { name: "naoqi-animations--Hey_1", label: "animations/Hey_1", recovery: false },
    { name: "recovery-power_on", label: "Power on", recovery: true },
  ],
};

describe("behaviourButtons", () => {
  it("shows the robot's own names and separates recoveries", () => {
    const { behaviours, recoveries } = behaviourButtons(DESCRIPTION);
    expect(behaviours).toEqual([
      { name: "Hello", label: "Hello" },
      { name: "naoqi-animations--Hey_1", label: "animations/Hey_1" },
    ]);
    expect(recoveries).toEqual([{ name: "recovery-power_on", label: "Power on" }]);
  });

  it("lists the behaviours of an agent that reports names only", () => {
    const { behaviours, recoveries } = behaviourButtons({ behaviours: ["bow"], robot_behaviours: [] });
    expect(behaviours).toEqual([{ name: "bow", label: "bow" }]);
    expect(recoveries).toEqual([]);
  });
});

describe("behaviourLabel", () => {
  it("keeps other names and works before the description", () => {
    expect(behaviourLabel(DESCRIPTION, "recovery-power_on")).toBe("Power on");
    expect(behaviourLabel(DESCRIPTION, "Hello")).toBe("Hello");
    expect(behaviourLabel(null, "Hello")).toBe("Hello");
  });
});
