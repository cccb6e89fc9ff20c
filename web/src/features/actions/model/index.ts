export { type ActionOptions, ActionRunner, type StepSource, ended, released, type Run, type RunStatus, type Step } from "./action-runner";
export { type BehaviourButton, behaviourButtons, behaviourLabel } from "./behaviours";
