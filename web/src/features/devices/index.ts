export { actionUnavailableReason, recoveryUnavailableReason, unavailableReason } from "./availability";
export { DeviceLists, faultsOf } from "./device-list";
export { EventLog } from "./event-log";
export { RateNotice } from "./rate-notice";
export { LastSeenAge, ReachChip } from "./reach-chip";
export { RenameDevice } from "./rename";
export { OperateSelected } from "./selection";
export { texts as deviceTexts } from "./texts";
