export { ControlBar } from "./control-bar";
export { useDeviceSessions } from "./device-sessions";
export { DevicePageFrame } from "./page-frame";
export { StopBanner, StopOutcomes } from "./stop-button";
