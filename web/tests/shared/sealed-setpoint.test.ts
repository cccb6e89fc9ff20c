import { describe, expect, it } from "vitest";
import type { Setpoint } from "../../src/shared/mqtt/protocol.generated";
import { sealed } from "../../src/shared/mqtt/sealed-setpoint";

describe("a sealed setpoint", () => {
  it("has the tag that the agent computes", () => {
    const key = Array.from({ length: 32 }, (_, index) => index.toString(16).padStart(2, "0")).join("");
    const setpoint = { epoch: 7 } as Setpoint;
    const message = sealed(setpoint, key, "ts/v1/s/a/arm/ctl/7");
    expect(JSON.stringify(message)).toBe('{"tag":"8cee6c4b32a7876f9bf1463a3792121a","body":{"epoch":7}}');
  });
});
