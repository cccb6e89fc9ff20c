import "./sensors.css";

export { CameraCard } from "./camera-card";
export { CameraSwitcher, useCameraSources } from "./camera-switcher";
export { CapturesCard } from "./captures-card";
export { DepthCard } from "./depth-card";
export { HistoryCard, useRecording } from "./history-card";
export { LidarCard } from "./lidar-card";
export { CollectDataCard } from "./measure-card";
export { Figure, Limits, ReadingsCard, valueText } from "./readings-card";
export { SettingsCard } from "./settings-card";
