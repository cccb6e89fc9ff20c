export { Fleet } from "./device-list";
export { DeviceStore, type OpenRequest, type Reach } from "./device-store";
export { newestFault } from "./faults";
export { type DeviceFilter, isRoomDevice, type KindFilter, matchesFilter, type OwnerFilter } from "./filter";
export { recordedDevices } from "./recorded-cameras";
export { currentFrame, followFrames, type Frames, type LatestFrame, NO_FRAMES } from "./frame-reader";
