export { CameraSwitcher, useCameraSources } from "./camera-switcher";
export { HistoryCard, useRecording } from "./history-card";
export { Figure, Limits, valueText } from "./readings-card";
export { RoomDevicePage } from "./room-device-page";
