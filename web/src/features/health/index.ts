export { HealthChip } from "./health-chip";
