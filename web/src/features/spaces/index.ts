export { Drawing, FloorPlan, useFloorPlan } from "./floor-plan";
export { SpaceList } from "./space-list";
