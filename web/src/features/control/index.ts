export { CommandTraceCard } from "./command-trace-card";
export { ControlBar } from "./control-bar";
export { StopBanner } from "./stop-button";
