export { CommandTrace, type ObservedBy, type TraceLine, type TraceStatus } from "./command-trace";
export { DeviceSession } from "./device-session";
export { Control } from "./lease";
export { StopSwitch } from "./stop";
export { Watchers } from "./watchers";
