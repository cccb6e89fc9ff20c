/** Form fields for a movement's parameters: converts text to values, with an error per field. */
import { degrees, radians } from "../../../shared/lib/angles";
import type { ObjectSchema, Parameters, Schema } from "../../../shared/api/movement-library";

/** `list`: a sequence of numbers. `json`: any other value. */
export type FieldKind = "number" | "integer" | "text" | "choice" | "yes-no" | "list" | "json";

export interface Field {
  name: string;
  kind: FieldKind;
  title: string;
  description: string;
  /** The displayed unit: degrees for angles. */
  unit: string;
  required: boolean;
  schema: Schema;
  choices: readonly string[];
  /** In the displayed unit. */
  least: number | null;
  most: number | null;
}

export type Wrong =
  | { kind: "missing" | "number" | "whole" | "json" }
  | { kind: "above" | "below" | "least" | "most" | "shorter" | "longer" | "fewer" | "more"; limit: number };

/** The entered text by field. */
export type Filled = Readonly<Record<string, string>>;

interface Read {
  values: Parameters;
  wrong: Readonly<Record<string, Wrong>>;
}

const DEGREES: Readonly<Record<string, string>> = { rad: "°", "rad/s": "°/s", "rad/s²": "°/s²" };
const TRUE = "true";

export function fieldsOf(schema: ObjectSchema | null): Field[] {
  const required = new Set(schema?.required ?? []);
  return Object.entries(schema?.properties ?? {}).map(([name, one]) => ({
    name,
    kind: kindOf(one),
    title: one.title ?? named(name),
    description: one.description ?? "",
    unit: DEGREES[one.unit ?? ""] ?? one.unit ?? "",
    required: required.has(name) && one.default === undefined,
    schema: one,
    choices: one.type === "string" ? (one.enum ?? []) : [],
    least: limit(one, "minimum"),
    most: limit(one, "maximum"),
  }));
}

/** Initial texts: the last used values if they are still valid, otherwise the defaults. */
export function fill(fields: readonly Field[], used: Parameters = {}): Filled {
  return Object.fromEntries(fields.map((field) => [field.name, startText(field, used[field.name])]));
}

/** The values of a form. Empty optional fields are omitted, so that the script's default applies. */
export function read(fields: readonly Field[], filled: Filled): Read {
  const values: Parameters = {};
  const wrong: Record<string, Wrong> = {};
  for (const field of fields) {
    const found = readField(field, filled[field.name] ?? "");
    if ("wrong" in found) wrong[field.name] = found.wrong;
    else if (found.value !== undefined) values[field.name] = found.value;
  }
  return { values, wrong };
}

type Found = { value: unknown } | { wrong: Wrong };

function readField(field: Field, text: string): Found {
  if (field.kind === "yes-no") return { value: text === TRUE };
  const empty = field.kind === "text" || field.kind === "choice" ? text === "" : text.trim() === "";
  if (empty) return field.required ? { wrong: { kind: "missing" } } : { value: undefined };
  switch (field.kind) {
    case "number":
    case "integer":
      return readNumber(field.schema, text, field.kind === "integer");
    case "list":
      return readList(field.schema, text);
    case "json":
      try {
        return { value: JSON.parse(text) as unknown };
      } catch {
        return { wrong: { kind: "json" } };
      }
    case "text":
    case "choice":
      return readText(field.schema, text);
  }
}

function readNumber(schema: Schema, text: string, whole: boolean): Found {
  const shown = Number(text.trim().replace(",", "."));
  if (!Number.isFinite(shown)) return { wrong: { kind: "number" } };
  if (whole && !Number.isSafeInteger(shown)) return { wrong: { kind: "whole" } };
  const value = inDegrees(schema) ? radians(shown) : shown;
  const wrong = outside(schema, shown);
  if (wrong !== null) return { wrong };
  if (schema.type !== "number" && schema.type !== "integer") return { value };
  // A limit in degrees is rounded for display: use the exact limit at the limit.
  return { value: Math.min(Math.max(value, schema.minimum ?? value), schema.maximum ?? value) };
}

function outside(schema: Schema, shown: number): Wrong | null {
  const bound = (key: Limit): number | null => limit(schema, key);
  const [least, most, above, below] = [bound("minimum"), bound("maximum"), bound("exclusiveMinimum"), bound("exclusiveMaximum")];
  if (least !== null && shown < least) return { kind: "least", limit: least };
  if (most !== null && shown > most) return { kind: "most", limit: most };
  if (above !== null && shown <= above) return { kind: "above", limit: above };
  if (below !== null && shown >= below) return { kind: "below", limit: below };
  return null;
}

function readText(schema: Schema, text: string): Found {
  const { minLength, maxLength } = schema.type === "string" ? schema : {};
  const length = Array.from(text).length;
  if (minLength !== undefined && length < minLength) return { wrong: { kind: "shorter", limit: minLength } };
  if (maxLength !== undefined && length > maxLength) return { wrong: { kind: "longer", limit: maxLength } };
  return { value: text };
}

function readList(schema: Schema, text: string): Found {
  if (schema.type !== "array") return { wrong: { kind: "json" } };
  const values: unknown[] = [];
  for (const part of text.split(/[;\s]+|,\s+|,(?=\S)/).filter((one) => one !== "")) {
    const found = readNumber(schema.items, part, schema.items.type === "integer");
    if ("wrong" in found) return found;
    values.push(found.value);
  }
  if (values.length < (schema.minItems ?? 0)) return { wrong: { kind: "fewer", limit: schema.minItems ?? 0 } };
  if (values.length > (schema.maxItems ?? Infinity)) return { wrong: { kind: "more", limit: schema.maxItems ?? 0 } };
  return { value: values };
}

function startText(field: Field, used: unknown): string {
  const text = textOf(field, used);
  if (text !== "" && !("wrong" in readField(field, text))) return text;
  return textOf(field, field.schema.default);
}

function textOf(field: Field, value: unknown): string {
  if (field.kind === "yes-no") return typeof value === "boolean" ? String(value) : "";
  if (value === undefined || value === null) return "";
  if (field.kind === "json") return JSON.stringify(value);
  if (field.kind === "list") return Array.isArray(value) && field.schema.type === "array" ? listText(field.schema.items, value) : "";
  if (typeof value === "number") return numberText(field.schema, value);
  if (typeof value !== "string") return "";
  return field.kind === "choice" && !field.choices.includes(value) ? "" : value;
}

function listText(items: Schema, values: readonly unknown[]): string {
  return values.map((value) => (typeof value === "number" ? numberText(items, value) : "")).join(" ");
}

function numberText(schema: Schema, value: number): string {
  return String(inDegrees(schema) ? rounded(degrees(value)) : value);
}

function kindOf(schema: Schema): FieldKind {
  switch (schema.type) {
    case "string":
      return schema.enum === undefined ? "text" : "choice";
    case "boolean":
      return "yes-no";
    case "array":
      return schema.items.type === "number" || schema.items.type === "integer" ? "list" : "json";
    case "object":
      return "json";
    case "number":
    case "integer":
      return schema.type;
  }
}

type Limit = "minimum" | "maximum" | "exclusiveMinimum" | "exclusiveMaximum";

function limit(schema: Schema, key: Limit): number | null {
  const value = (schema as Partial<Record<Limit, unknown>>)[key];
  if (typeof value !== "number") return null;
  return inDegrees(schema) ? rounded(degrees(value)) : value;
}

function inDegrees({ unit, type }: Schema): boolean {
  return type === "number" && unit !== undefined && unit in DEGREES;
}

function rounded(value: number): number {
  return Math.round(value * 100) / 100;
}

/** `pause_s` → "Pause": the unit is shown beside the field. */
function named(name: string): string {
  const words = name.replace(/_(m|s|ms|rad|rad_s|m_s)$/, "").replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}
