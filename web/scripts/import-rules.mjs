// An ESLint rule: imports go app -> features -> shared, and a feature imports only features that precede it in the lists below.
// A feature imports another feature only through its index.ts, and a model only through model/index.ts, which never contains
// components. Models form the lower layer: a component may import every model.
import { dirname, relative, resolve } from "node:path";

const MODELS = [
  ...["account", "keyframes", "movements", "robot-types", "sharing", "spaces", "steering"],
  ...["pairing", "twin", "devices", "actions", "latency", "control", "sensors", "health", "autonomy"],
];
const COMPONENTS = [
  ...["sharing", "account", "twin", "devices", "pairing", "robot-types", "control", "sensors", "health"],
  ...["spaces", "steering", "actions", "latency", "keyframes", "movements", "autonomy"],
];
const SOURCE = resolve(import.meta.dirname, "../src");

function reason(from, to) {
  const [layer, feature] = from;
  if (to[0] !== "app" && to[0] !== "features" && to[0] !== "shared") return "";
  if (layer === "shared" && to[0] !== "shared") return "shared imports neither features nor the app";
  if (layer === "features" && to[0] === "app") return "a feature does not import the app";
  if (layer !== "features" || to[0] !== "features" || to[1] === feature) return "";
  const [, , ...inside] = to;
  if (from[2] === "model" && inside[0] !== "model") return "a model imports another feature's model/index.ts";
  const order = from[2] === "model" ? MODELS : inside[0] === "model" ? [] : COMPONENTS;
  const [own, other] = [order.indexOf(feature), order.indexOf(to[1])];
  if (order.length > 0 && (other < 0 || other > own)) return `${feature} must not import ${to[1]}: see the order in import-rules.mjs`;
  return inside.length === 0 || inside.join("/") === "model" ? "" : "import another feature through its index.ts or model/index.ts";
}

function check(context, node) {
  const path = node.source?.value;
  if (typeof path !== "string" || !path.startsWith(".")) return;
  const parts = (file) => relative(SOURCE, file).split("/");
  const message = reason(parts(context.filename), parts(resolve(dirname(context.filename), path)));
  if (message !== "") context.report({ node, message });
}

export default {
  rules: {
    layers: {
      meta: { type: "problem", schema: [] },
      create: (context) =>
        Object.fromEntries(
          ["ImportDeclaration", "ImportExpression", "ExportNamedDeclaration", "ExportAllDeclaration"].map((kind) => [
            kind,
            (node) => check(context, node),
          ]),
        ),
    },
  },
};
