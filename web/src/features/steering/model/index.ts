export type { Delay } from "./delay-meter";
export { SetpointStreamer, type Targets } from "./setpoint-streamer";
