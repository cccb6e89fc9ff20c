export { AgentCommands } from "./agent-commands";
export { FirstSteps } from "./first-steps";
export { PageExplainer } from "./page-explainer";
