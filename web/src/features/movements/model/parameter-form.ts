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
  min: number | null;
  max: number | null;
}

export type FieldError =
  | { kind: "missing" | "number" | "whole" | "json" }
  | { kind: "above" | "below" | "least" | "most" | "shorter" | "longer" | "fewer" | "more"; limit: number };

/** The entered text by field. */
export type FieldTexts = Readonly<Record<string, string>>;

interface Read {
  values: Parameters;
  errors: Readonly<Record<string, FieldError>>;
}

const DEGREES: Readonly<Record<string, string>> = { rad: "°", "rad/s": "°/s", "rad/s²": "°/s²" };
const TRUE = "true";

export function fieldsOf(schema: ObjectSchema | null): Field[] {
  const required = new Set(schema?.required ?? []);
  return Object.entries(schema?.properties ?? {}).map(([name, one]) => ({
    name,
    kind: kindOf(one),
    title: one.title ?? titleOf(name),
    description: one.description ?? "",
    unit: DEGREES[one.unit ?? ""] ?? one.unit ?? "",
    required: required.has(name) && one.default === undefined,
    schema: one,
    choices: one.type === "string" ? (one.enum ?? []) : [],
    min: limit(one, "minimum"),
    max: limit(one, "maximum"),
  }));
}

/** Initial texts: the last used values if they are still valid, otherwise the defaults. */
export function initialTexts(fields: readonly Field[], lastUsed: Parameters = {}): FieldTexts {
  return Object.fromEntries(fields.map((field) => [field.name, startText(field, lastUsed[field.name])]));
}

/** The values of a form. Empty optional fields are omitted, so that the script's default applies. */
export function read(fields: readonly Field[], fieldTexts: FieldTexts): Read {
  const values: Parameters = {};
  const errors: Record<string, FieldError> = {};
  for (const field of fields) {
    const found = readField(field, fieldTexts[field.name] ?? "");
    if ("error" in found) errors[field.name] = found.error;
    else if (found.value !== undefined) values[field.name] = found.value;
  }
  return { values, errors };
}

type Found = { value: unknown } | { error: FieldError };

function readField(field: Field, text: string): Found {
  if (field.kind === "yes-no") return { value: text === TRUE };
  const empty = field.kind === "text" || field.kind === "choice" ? text === "" : text.trim() === "";
  if (empty) return field.required ? { error: { kind: "missing" } } : { value: undefined };
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
        return { error: { kind: "json" } };
      }
    case "text":
    case "choice":
      return readText(field.schema, text);
  }
}

function readNumber(schema: Schema, text: string, whole: boolean): Found {
  const displayed = Number(text.trim().replace(",", "."));
  if (!Number.isFinite(displayed)) return { error: { kind: "number" } };
  if (whole && !Number.isSafeInteger(displayed)) return { error: { kind: "whole" } };
  const value = inDegrees(schema) ? radians(displayed) : displayed;
  const error = outside(schema, displayed);
  if (error !== null) return { error };
  if (schema.type !== "number" && schema.type !== "integer") return { value };
  // A limit in degrees is rounded for display: use the exact limit at the limit.
  return { value: Math.min(Math.max(value, schema.minimum ?? value), schema.maximum ?? value) };
}

function outside(schema: Schema, displayed: number): FieldError | null {
  const bound = (key: Limit): number | null => limit(schema, key);
  const [min, max, above, below] = [bound("minimum"), bound("maximum"), bound("exclusiveMinimum"), bound("exclusiveMaximum")];
  if (min !== null && displayed < min) return { kind: "least", limit: min };
  if (max !== null && displayed > max) return { kind: "most", limit: max };
  if (above !== null && displayed <= above) return { kind: "above", limit: above };
  if (below !== null && displayed >= below) return { kind: "below", limit: below };
  return null;
}

function readText(schema: Schema, text: string): Found {
  const { minLength, maxLength } = schema.type === "string" ? schema : {};
  const length = Array.from(text).length;
  if (minLength !== undefined && length < minLength) return { error: { kind: "shorter", limit: minLength } };
  if (maxLength !== undefined && length > maxLength) return { error: { kind: "longer", limit: maxLength } };
  return { value: text };
}

function readList(schema: Schema, text: string): Found {
  if (schema.type !== "array") return { error: { kind: "json" } };
  const values: unknown[] = [];
  for (const part of text.split(/[;\s]+|,\s+|,(?=\S)/).filter((one) => one !== "")) {
    const found = readNumber(schema.items, part, schema.items.type === "integer");
    if ("error" in found) return found;
    values.push(found.value);
  }
  if (values.length < (schema.minItems ?? 0)) return { error: { kind: "fewer", limit: schema.minItems ?? 0 } };
  if (values.length > (schema.maxItems ?? Infinity)) return { error: { kind: "more", limit: schema.maxItems ?? 0 } };
  return { value: values };
}

function startText(field: Field, lastUsed: unknown): string {
  const text = textOf(field, lastUsed);
  if (text !== "" && !("error" in readField(field, text))) return text;
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

/** `pause_s` → "Pause": the unit is shown next to the field. */
function titleOf(name: string): string {
  const words = name.replace(/_(m|s|ms|rad|rad_s|m_s)$/, "").replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}
