/** Cameras that may be recorded, and those that are being recorded. */
import type { DeviceStore } from "./device-store";

/** Names of the cameras with pictures in colour; only these can be recorded. */
export function recordableCameras(device: DeviceStore): string[] {
  return (device.description.value?.cameras ?? []).filter(({ kind }) => kind === "colour").map(({ name }) => name);
}

interface RecordedDevice {
  label: string;
  cameras: string[];
}

/**
 * Devices of a room whose own cameras are being recorded. A robot also reports cameras of room devices, with a `/` in their
 * names, and the room devices report these themselves. A session ends with the link, so an offline device records none.
 */
export function recordedDevices(devices: readonly DeviceStore[]): RecordedDevice[] {
  return devices.flatMap(({ info, reach, state }) => {
    if (reach.value === "offline") return [];
    const cameras = (state.value?.recorded_cameras ?? []).filter((name) => !name.includes("/"));
    return cameras.length === 0 ? [] : [{ label: info.value.label, cameras }];
  });
}
