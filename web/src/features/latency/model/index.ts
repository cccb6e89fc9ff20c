export { RoundTrip } from "./round-trip";
export { LatencySamples } from "./sample-upload";
