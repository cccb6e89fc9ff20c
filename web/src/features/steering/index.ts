export { JointSlider } from "./joint-slider";
export { SteeringCard } from "./steering-card";
export { texts as steeringTexts } from "./texts";
