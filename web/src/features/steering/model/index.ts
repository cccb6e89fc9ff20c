export { SetpointStreamer, type Targets } from "./setpoint-streamer";
