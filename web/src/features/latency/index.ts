export { CommandTraceCard } from "./command-trace-card";
