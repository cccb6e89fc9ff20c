export { barsOf, SPANS, type Bar, type Span, startOf } from "./bars";
export { SessionHistory } from "./session-history";
export { durationText, metricsOf, ratioText, secondsOf, shareText } from "./figures";
export { conditionOf, MAX_SEED, rateText, seedOf, TrialHistory } from "./tasks";
