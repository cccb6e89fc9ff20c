export { rollPitchYaw, unit } from "./forward-kinematics";
export { RecentTelemetry } from "./recent-telemetry";
