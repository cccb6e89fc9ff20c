export { Fleet } from "./device-list";
export { DeviceStore, type OpenRequest, type Reach } from "./device-store";
export { type DeviceFilter, type KindFilter, matchesFilter, type OwnerFilter } from "./filter";
