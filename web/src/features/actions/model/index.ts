export { type ActionOptions, ActionRunner, type StepSource, ended, type Run, type RunStatus, type Step } from "./action-runner";
