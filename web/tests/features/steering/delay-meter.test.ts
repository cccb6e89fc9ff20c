import { describe, expect, it } from "vitest";
import { DelayMeter } from "../../../src/features/steering/model/delay-meter";
import { readTelemetry, type KnownTelemetry } from "../../../src/shared/mqtt/parse-messages";
import { bytes, telemetry } from "../../support/messages";

function message(sequence: number, tickMs: number, loopAgeMs = 20): KnownTelemetry {
  return readTelemetry(bytes(telemetry({ sequence, tick_ms: tickMs, loop_age_ms: loopAgeMs })));
}

describe("the cause of a delay", () => {
  it("is none while timer and telemetry are regular", () => {
    const meter = new DelayMeter();
    for (let at = 0; at < 500; at += 25) {
      meter.tick(at);
      meter.receive(message(at + 1, at), at);
    }
    expect(meter.longest(500)).toBeNull();
  });

  it("is the browser if its timer was late, although its telemetry was late as well", () => {
    const meter = new DelayMeter();
    meter.tick(0);
    meter.receive(message(1, 0), 0);
    meter.tick(320);
    meter.receive(message(2, 20), 330);
    expect(meter.longest(330)).toEqual({ cause: "browser", ms: 320 });
  });

  it("is the network if telemetry or setpoints arrive late", () => {
    const late = new DelayMeter();
    late.receive(message(1, 0), 0);
    late.receive(message(2, 20), 400);
    expect(late.longest(400)).toEqual({ cause: "network", ms: 380 });
    const aged = new DelayMeter();
    aged.receive(message(1, 0), 0);
    aged.receive(message(2, 20, 180), 20);
    expect(aged.longest(20)).toEqual({ cause: "network", ms: 180 });
    const stalled = new DelayMeter();
    stalled.wait(100, 350);
    expect(stalled.longest(350)).toEqual({ cause: "network", ms: 250 });
  });

  it("is the robot's computer if the robot itself published late", () => {
    const meter = new DelayMeter();
    meter.receive(message(1, 0), 0);
    meter.receive(message(2, 350), 350);
    expect(meter.longest(350)).toEqual({ cause: "robot", ms: 350 });
  });

  it("is forgotten after 1.5 s, and after a restart of the robot", () => {
    const meter = new DelayMeter();
    meter.tick(0);
    meter.tick(200);
    expect(meter.longest(1_699)).toEqual({ cause: "browser", ms: 200 });
    expect(meter.longest(1_700)).toBeNull();
    meter.receive(message(900, 90_000), 1_700);
    meter.receive(message(1, 10), 1_800);
    expect(meter.longest(1_800)).toBeNull();
  });
});
