export { actionUnavailableReason, unavailableReason } from "./availability";
export { DeviceLists } from "./device-list";
export { useDeviceSessions } from "./device-sessions";
export { EventLog } from "./event-log";
export { DevicePageFrame } from "./page-frame";
export { LastSeenAge, ReachChip } from "./reach-chip";
export { RenameDevice } from "./rename";
