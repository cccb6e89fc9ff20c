import { describe, expect, it } from "vitest";
import { recordableCameras, recordedDevices } from "../../../src/features/devices/model/recorded-cameras";
import { deliver, device, pass } from "../../support/console";
import { description, state } from "../../support/messages";

describe("recorded cameras", () => {
  it("are the own cameras of a device that is not offline", async () => {
    deliver("conn", { online: true, session: 1, at_ms: Date.now() });
    deliver("state", state(1, null, { recorded_cameras: ["front", "a1-door/eye"] }));
    expect(recordedDevices([device])).toEqual([{ label: "Arm", cameras: ["front"] }]);
    await pass(5_000); // stale: it may still record
    expect(recordedDevices([device])).toHaveLength(1);
    deliver("conn", { online: false, session: 1, at_ms: Date.now() });
    expect(recordedDevices([device])).toEqual([]);
  });

  it("do not include cameras that only a robot's session contains", () => {
    deliver("state", state(1, null, { recorded_cameras: ["a1-door/eye"] }));
    expect(recordedDevices([device])).toEqual([]);
    deliver("state", state(2));
    expect(device.state.value).toMatchObject({ recorded_cameras: [], camera_consent: null });
  });

  it("can be those with pictures in colour", () => {
    const cameras = [{ name: "front", rate_hz: 5 }, { name: "depth", rate_hz: 5, kind: "depth" }];
    deliver("desc", { ...description, cameras });
    expect(recordableCameras(device)).toEqual(["front"]);
  });

  it("of a state with an invalid consent are an unreadable message", () => {
    deliver("state", state(1, null, { camera_consent: { cameras: [7] } }));
    expect(device.parseError.value).toContain("camera_consent");
  });
});
