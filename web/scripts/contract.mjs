// Writes src/shared/mqtt/protocol.generated.ts from docs/asyncapi.json; with --check fails if the file is stale.
// It supports the part of JSON Schema that the document uses and rejects the rest.
import { readdirSync, readFileSync, writeFileSync } from "node:fs";

const source = new URL("../../docs/asyncapi.json", import.meta.url);
const target = new URL("../src/shared/mqtt/protocol.generated.ts", import.meta.url);
const web = new URL("../", import.meta.url);

const HEAD = `// Generated from docs/asyncapi.json by \`make contract\`; do not edit.
// The types that the console uses. parse-messages.ts validates received messages. SI units and radians.
`;

/** Keys that restrict a value without changing its TypeScript type. */
const NO_TYPE = new Set([
  "title", "description", "default", "minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "minLength",
  "maxLength", "pattern", "minItems", "maxItems", "minProperties", "maxProperties", "discriminator", "required",
  "propertyNames",
]);

const TYPES = { string: "string", number: "number", integer: "number", boolean: "boolean", null: "null" };

function typeOf(schema, at) {
  const keys = Object.keys(schema).filter((key) => !NO_TYPE.has(key));
  const has = (...expected) => keys.length === expected.length && expected.every((key) => keys.includes(key));
  if (has()) return "unknown";
  if (has("$ref")) return schema.$ref.split("/").pop();
  if (keys.includes("enum")) return schema.enum.map((value) => JSON.stringify(value)).join(" | ");
  if (has("anyOf")) return schema.anyOf.map((one) => typeOf(one, at)).join(" | ");
  if (has("type") && schema.type in TYPES) return TYPES[schema.type];
  if (has("type") && schema.type === "object") return "Record<string, unknown>";
  if (has("type", "additionalProperties")) return `Record<string, ${typeOf(schema.additionalProperties, at)}>`;
  if (has("type", "prefixItems", "items")) return `[${schema.prefixItems.map((one) => typeOf(one, at)).join(", ")}]`;
  if (has("type", "items")) {
    const item = typeOf(schema.items, at);
    return item.includes(" | ") ? `(${item})[]` : `${item}[]`;
  }
  throw new Error(`${at}: unsupported schema keys ${keys.join(", ")}`);
}

function comment(text, indent = "") {
  if (text === undefined) return "";
  const lines = text.replaceAll("``", "`").replaceAll("*/", "* /").split("\n").map((line) => line.trim());
  if (lines.length === 1) return `${indent}/** ${lines[0]} */\n`;
  return `${indent}/**\n${lines.map((line) => `${indent} * ${line}`.trimEnd()).join("\n")}\n${indent} */\n`;
}

function declaration(name, schema) {
  if (schema.properties === undefined && schema.type !== "object") {
    return `${comment(schema.description)}export type ${name} = ${typeOf(schema, name)};\n`;
  }
  const required = new Set(schema.required ?? []);
  const fields = Object.entries(schema.properties ?? {}).map(([field, one]) => {
    const type = typeOf(one, `${name}.${field}`);
    return `${comment(one.description, "  ")}  ${field}${required.has(field) ? "" : "?"}: ${type};\n`;
  });
  if (fields.length === 0) return `${comment(schema.description)}export type ${name} = Record<string, never>;\n`;
  return `${comment(schema.description)}export interface ${name} {\n${fields.join("")}}\n`;
}

const { schemas } = JSON.parse(readFileSync(source, "utf8")).components;

/** Names that the console and its tests import from the generated file. */
function imported() {
  const files = ["src", "tests"].flatMap((folder) => readdirSync(new URL(folder, web), { recursive: true }).map((file) => `${folder}/${file}`));
  const lists = files
    .filter((file) => /\.tsx?$/.test(file))
    .flatMap((file) => [...readFileSync(new URL(file, web), "utf8").matchAll(/\{([^{}]*)\} from "[^"]*protocol\.generated"/g)]);
  return lists.flatMap(([, list]) => list.match(/\w+/g) ?? []).filter((name) => name in schemas);
}

const used = new Set(imported());
// A set also visits members that are added during the iteration.
for (const name of used) {
  for (const [, other] of JSON.stringify(schemas[name]).matchAll(/"\$ref":"[^"]*\/(\w+)"/g)) used.add(other);
}
const declarations = Object.entries(schemas).filter(([name]) => used.has(name)).map(([name, schema]) => declaration(name, schema));
const text = [HEAD, ...declarations].join("\n");

if (process.argv.includes("--check")) {
  if (readFileSync(target, "utf8") !== text) {
    process.stderr.write("web/src/shared/mqtt/protocol.generated.ts is stale; run `make contract`\n");
    process.exit(1);
  }
} else {
  writeFileSync(target, text);
}
