import type { DeviceStore } from "../devices/model";
import type { SetpointStreamer } from "./model/setpoint-streamer";
import type { PadWatch } from "./inputs/use-gamepad";

/** What each way of steering gets. */
export interface PanelProps {
  device: DeviceStore;
  /** There while this page may move the robot. */
  streamer: SetpointStreamer | null;
  /** Whether keys and gamepad are this robot's. */
  active: boolean;
  pad: PadWatch;
}
