export { ActionCards } from "./action-cards";
export { RunStatusPanel, RunSteps } from "./run-status";
export { describeRequest, texts as actionTexts } from "./texts";
