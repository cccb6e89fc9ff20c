import { describe, expect, test } from "vitest";
import { storedDraft, storedParameters } from "../../../src/shared/lib/local-storage";
import type { ObjectSchema } from "../../../src/shared/api/movement-library";
import { fieldsOf, initialTexts, read } from "../../../src/features/movements/model/parameter-form";
import { FakeStorage } from "../../support/fake-storage";

const SCHEMA: ObjectSchema = {
  type: "object",
  properties: {
    times: { type: "integer", minimum: 1, maximum: 20, default: 3 },
    angle_rad: { type: "number", minimum: -Math.PI / 2, maximum: Math.PI / 2, default: 0.5, unit: "rad" },
    word: { type: "string", minLength: 2, maxLength: 4 },
    colour: { type: "string", enum: ["red", "green"], default: "green" },
    loud: { type: "boolean", default: true },
    place_m: { type: "array", items: { type: "number" }, minItems: 2, maxItems: 3, unit: "m" },
    more: { type: "object", additionalProperties: true },
    share: { type: "number", exclusiveMinimum: 0, exclusiveMaximum: 1, default: 0.5 },
  },
  required: ["word"],
};
const fields = fieldsOf(SCHEMA);
const valid = { ...initialTexts(fields), word: "hey" };

describe("a form for parameters", () => {
  test("starts with the defaults, angles in degrees", () => {
    expect(initialTexts(fields)).toEqual({
      times: "3", angle_rad: "28.65", word: "", colour: "green", loud: "true", place_m: "", more: "", share: "0.5",
    });
    expect(fields.map(({ kind }) => kind)).toEqual(["integer", "number", "text", "choice", "yes-no", "list", "json", "number"]);
    expect(fields[1]).toMatchObject({ title: "Angle", unit: "°", min: -90, max: 90 });
  });

  test("returns values in the units of the script, and omits empty optional fields", () => {
    const { values, errors } = read(fields, { ...valid, angle_rad: "90", place_m: "1.5, -2" });
    expect(errors).toEqual({});
    expect(values).toEqual({
      times: 3, angle_rad: Math.PI / 2, word: "hey", colour: "green", loud: true, place_m: [1.5, -2], share: 0.5,
    });
  });

  test.each([
    ["times", "", undefined],
    ["times", "2.5", "whole"],
    ["times", "x", "number"],
    ["times", "0", "least"],
    ["times", "21", "most"],
    ["angle_rad", "90.5", "most"],
    ["word", "", "missing"],
    ["word", "a", "shorter"],
    ["word", "abcde", "longer"],
    ["place_m", "1", "fewer"],
    ["place_m", "1 2 3 4", "more"],
    ["place_m", "1 b", "number"],
    ["more", "{", "json"],
    ["share", "0", "above"],
    ["share", "1", "below"],
    ["share", "Infinity", "number"],
  ])("%s = '%s' is %s", (name, text, kind) => {
    expect(read(fields, { ...valid, [name]: text }).errors[name]?.kind).toBe(kind);
  });

  test("starts with the values used last, unless they are no longer valid", () => {
    const shown = initialTexts(fields, { times: 7, angle_rad: 9, colour: "blue", loud: false, place_m: [1, 2], word: "x" });
    expect(shown).toMatchObject({ times: "7", angle_rad: "28.65", colour: "green", loud: "false", place_m: "1 2", word: "" });
    expect(fieldsOf(null)).toEqual([]);
  });
});

describe("stored values", () => {
  test("belong to one account and movement", () => {
    const storage = new FakeStorage();
    const draft = { source: "x", basedOn: 2, at: 1 };
    expect(storedDraft(storage, "ann", "ur5", "wave").write(draft)).toBe(true);
    expect(storedDraft(storage, "ann", "ur5", "wave").read()).toEqual(draft);
    expect(storedDraft(storage, "bob", "ur5", "wave").read()).toBeNull();
    expect(storedParameters(storage, "ann", "ur5", "wave").read()).toBeNull();
    storedDraft(storage, "ann", "ur5", "wave").remove();
    expect(storedDraft(storage, "ann", "ur5", "wave").read()).toBeNull();
  });

  test("are absent if they are invalid or storage is unavailable", () => {
    const storage = new FakeStorage();
    for (const text of ["{", '{"source": 1}']) {
      storage.setItem("telescope.draft.ann.ur5.wave", text);
      expect(storedDraft(storage, "ann", "ur5", "wave").read()).toBeNull();
    }
    expect(storedDraft(null, "ann", "ur5", "wave").write({ source: "x", basedOn: 0, at: 1 })).toBe(false);
  });
});
