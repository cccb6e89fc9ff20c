export { CommandTrace } from "./command-trace";
export { Control } from "./lease";
export { StopSwitch } from "./stop";
export { Watchers } from "./watchers";
