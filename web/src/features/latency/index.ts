export { LiveLatency } from "./live-latency-card";
