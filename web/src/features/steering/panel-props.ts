import type { DeviceStore } from "../devices/model";
import type { SetpointStreamer } from "./model/setpoint-streamer";
import type { GamepadState } from "./inputs/use-gamepad";

/** Properties of every steering panel. */
export interface PanelProps {
  device: DeviceStore;
  /** `null` while this page cannot move the robot. */
  streamer: SetpointStreamer | null;
  /** Whether keyboard and gamepad control this robot. */
  active: boolean;
  pad: GamepadState;
}
