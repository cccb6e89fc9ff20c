export { JointSlider } from "./joint-slider";
export { MultiRobotCheckbox, OperateSelected } from "./multi-select";
export { SteeringCard } from "./steering-card";
export { texts as steeringTexts } from "./texts";
