export { JointSlider } from "./joint-slider";
export { MultiRobotCheckbox, OperateSelected } from "./multi-robot/selection";
export { SteeringCard } from "./steering-card";
export { texts as steeringTexts } from "./texts";
