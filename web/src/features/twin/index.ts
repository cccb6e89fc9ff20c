export { JointPoseTable } from "./joint-pose-table";
export type { LiveScene } from "./scene";
export { TelemetryPlot } from "./telemetry-plot";
export { TwinView } from "./twin-view";
export { useScene } from "./use-scene";
