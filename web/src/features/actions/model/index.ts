export { type ActionOptions, ActionRunner, type Channel, ended, type Run, type RunStatus, type Step } from "./action-runner";
