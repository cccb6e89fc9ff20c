export { Comparison, type ComparisonState } from "./comparison";
export type { Differences, JointDifference, SessionFigures } from "./differences";
export { type Alignment, readSelection, type Selection, selectionText } from "./selection";
