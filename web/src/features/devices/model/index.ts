export { Fleet } from "./device-list";
export { DeviceSession } from "./device-session";
export { DeviceStore, type OpenRequest, type Reach } from "./device-store";
