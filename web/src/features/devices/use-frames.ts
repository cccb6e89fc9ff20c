/** Subscribes to frames of one kind and reads the newest. */
import { type DeviceStore, followFrames, type Frames, NO_FRAMES } from "./model";
import { useEffect, useState } from "preact/hooks";
import type { FrameKind } from "../../shared/mqtt/camera-frame";

/** The first stream of this kind in the description. */
export function frameStream(device: DeviceStore, kind: FrameKind): { name: string; rate_hz: number } | null {
  return device.description.value?.cameras.find((one) => one.kind === kind) ?? null;
}

/** While `active`, the newest frame of a stream; `name`: `null` for none. Of the frames that arrive during `read`, the newest is read next. */
export function useFrames<T>(
  device: DeviceStore,
  kind: FrameKind,
  name: string | null,
  active: boolean,
  read: (content: Uint8Array) => T | Promise<T>,
): Frames<T> {
  const [frames, setFrames] = useState<Frames<T>>(NO_FRAMES);
  useEffect(() => {
    if (!active || name === null) return;
    return followFrames(device, name, kind, read, setFrames);
    // `read` is a function of its module.
  }, [device, kind, name, active]);
  return frames;
}
