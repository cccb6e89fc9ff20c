import type { DeviceStore } from "../../core/device";
import type { SetpointStreamer } from "../../core/streamer";
import type { PadWatch } from "./gamepad";

/** What each way of steering gets. */
export interface PanelProps {
  device: DeviceStore;
  /** There while this page may move the robot. */
  streamer: SetpointStreamer | null;
  /** Whether keys and gamepad are this robot's. */
  active: boolean;
  pad: PadWatch;
}
