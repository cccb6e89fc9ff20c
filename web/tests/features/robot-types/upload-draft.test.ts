import { beforeEach, describe, expect, it } from "vitest";
import { readFinding, readFindings } from "../../../src/features/robot-types/model/parse-findings";
import { ApiError } from "../../../src/shared/api/http";
import type { TypePreview, RobotType, RobotTypes, TypeFolder, TypeModel } from "../../../src/shared/api/robot-types";
import { UploadDraft } from "../../../src/features/robot-types/model/upload-draft";
import { selectFiles, packFiles } from "../../../src/features/robot-types/model/upload-files";

const bytes = (text: string): Uint8Array => new TextEncoder().encode(text);
const folder = (...names: string[]): Map<string, Uint8Array> => new Map(names.map((name) => [name, bytes(name)]));

describe("a folder", () => {
  it("contains the files next to its manifest, at any depth", () => {
    const { files, ignored } = selectFiles(
      folder("my/robots/lever/robot.toml", "my/robots/lever/lever.xml", "my/robots/lever/movements/up.py",
        "my/robots/lever/meshes/hand.stl", "my/robots/lever/README.md", "my/notes.txt", "__MACOSX/lever/robot.toml",
        "my/robots/lever/.DS_Store", "my/robots/lever/"),
    );
    expect([...files.keys()].sort()).toEqual(["lever.xml", "meshes/hand.stl", "movements/up.py", "robot.toml"]);
    expect(ignored).toEqual(["my/robots/lever/README.md", "my/notes.txt"]);
  });

  it("without a manifest contains all files, without their common parent folder", () => {
    expect([...selectFiles(folder("lever/lever.xml", "lever/scene.xml")).files.keys()]).toEqual(["lever.xml", "scene.xml"]);
    expect([...selectFiles(folder("movements/up.py")).files.keys()]).toEqual(["movements/up.py"]);
  });

  it("is sent as text, and binary files as base64", () => {
    const large = new Uint8Array(100_000).map((_, index) => index % 256);
    const packed = packFiles(new Map([...folder("robot.toml", "lever.xml", "movements/up.py"), ["hand.stl", large]]));
    expect(packed?.manifest).toBe("robot.toml");
    expect(packed?.files["lever.xml"]).toBe("lever.xml");
    expect(packed?.movements).toEqual({ up: "movements/up.py" });
    expect(Buffer.from(packed?.files["hand.stl"] ?? "", "base64")).toEqual(Buffer.from(large));
    expect(packFiles(folder("lever.xml"))).toBeNull();
  });
});

describe("a finding", () => {
  it.each([
    ["lever.xml: the range of joint 'shoulder' is -0.5000 to 0.5000 rad; the manifest's must lie within (…).", "range", null, "shoulder"],
    ["lever.xml: 'hand.stl' is not among the files (line 2).", "missing", 2, "hand.stl"],
    ["scene.xml: mismatched tag: line 3, column 15.", "malformed", 3, ""],
    ["lever.xml: XML parse error 14: Error=XML_ERROR_MISMATCHED_ELEMENT ErrorID=14 (0xe) Line number=1: XMLElement name=body.", "malformed", 1, ""],
    ["lever.xml: XML Error: invalid keyword: 'boxx' Element 'geom', line 4.", "keyword", 4, "boxx"],
    ["lever.xml: XML Error: Schema violation: unrecognized element Element 'sight', line 8.", "element", 8, "sight"],
    ["lever.xml: no joint 'shoulder'; the model has: hip.", "unnamed", null, "shoulder"],
    ["robot.toml: Expected '=' after a key in a key/value pair (at line 5, column 8).", "manifest", 5, "="],
    ["robot.toml: model is 'no.xml'; it must be one of the .xml files: lever.xml.", "field", null, "no.xml"],
    ["movements/up.py: Line 1: '(' was never closed.", "script", 1, "("],
    ["The model takes MuJoCo more than 15 s. Simplify it.", "heavy", null, ""],
    ["something new", "other", null, ""],
  ])("is classified: %s", (error, kind, line, about) => {
    const found = readFinding(error);
    expect([found.kind, found.line, found.subject]).toEqual([kind, line, about]);
    expect(found.file === "" || error.startsWith(found.file)).toBe(true);
  });

  it("has the range that the model allows, and is listed by file and line", () => {
    expect(readFinding("a.xml: the range of joint 'j' is -0.5000 to 0.5000 rad; x").range_rad).toEqual([-0.5, 0.5]);
    const found = readFindings(["b.xml: x: line 9", "a.xml: y", "b.xml: z: line 2", "all"]);
    expect(found.map(({ file, line }) => `${file}:${line ?? ""}`)).toEqual([":", "a.xml:", "b.xml:2", "b.xml:9"]);
  });
});

/** An API whose check returns the prepared results. */
class FakeChecker {
  readonly checked: TypeFolder[] = [];
  readonly dropped: string[] = [];
  errors: string[] = [];
  /** How many polls the check takes. */
  open = 1;
  failure: Error | null = null;

  #preview(id: string, state: "checking" | "ready" | "rejected"): TypePreview {
    const errors = state === "rejected" ? this.errors : [];
    return { id, expires_at: "", robot_type: { type: "lever", upload: { version: 1, state, errors, warnings: [], uploaded_at: "" } } as unknown as RobotType };
  }

  createPreview(files: TypeFolder): Promise<TypePreview> {
    if (this.failure !== null) return Promise.reject(this.failure);
    return Promise.resolve(this.#preview(`preview${this.checked.push(files)}`, "checking"));
  }

  preview(id: string): Promise<TypePreview> {
    this.open -= 1;
    return Promise.resolve(this.#preview(id, this.open > 0 ? "checking" : this.errors.length > 0 ? "rejected" : "ready"));
  }

  previewModel(): Promise<TypeModel> {
    return Promise.resolve({ twin: { device: "lever", bodies: [] }, actuators: [], cameras: [] });
  }

  savePreview(): Promise<RobotType> {
    return Promise.resolve(this.#preview("", "ready").robot_type);
  }

  putMovement(_: string, name: string): Promise<unknown> {
    return name === "bad" ? Promise.reject(new ApiError(422, "movement-invalid", "Line 1: no.")) : Promise.resolve({});
  }

  deletePreview(id: string): Promise<void> {
    this.dropped.push(id);
    return Promise.resolve();
  }
}

describe("a draft", () => {
  let checker: FakeChecker;
  let draft: UploadDraft;

  beforeEach(() => {
    checker = new FakeChecker();
    draft = new UploadDraft(checker as unknown as RobotTypes);
  });

  const whole = folder("lever/robot.toml", "lever/lever.xml", "lever/movements/up.py", "lever/movements/bad.py");

  it("is checked when files are added, previewed, and saved with its movements", async () => {
    await draft.add(whole);
    expect(draft.step.value).toBe("valid");
    expect(draft.model.value?.twin.device).toBe("lever");
    expect(Object.keys(checker.checked[0]?.movements ?? {})).toEqual(["up", "bad"]);
    await draft.save();
    expect(draft.step.value).toBe("saved");
    expect(draft.movements.value).toEqual([{ name: "up", error: "" }, { name: "bad", error: "Line 1: no." }]);
    expect(checker.dropped).toEqual([]);
  });

  it("keeps its files when it is rejected, and is checked again after a file is replaced", async () => {
    checker.errors = ["lever.xml: mismatched tag: line 3, column 1."];
    await draft.add(whole);
    expect([draft.step.value, draft.errors.value.length]).toEqual(["invalid", 1]);
    checker.errors = [];
    checker.open = 1;
    await draft.replace("lever.xml", bytes("<mujoco/>"));
    expect([draft.step.value, draft.files.value.size]).toEqual(["valid", 4]);
    expect(checker.checked[1]?.files["lever.xml"]).toBe("<mujoco/>");
    expect(checker.dropped).toEqual(["preview1"]);
  });

  it("distinguishes rejection from an unreachable server", async () => {
    checker.failure = new ApiError(422, "manifest-invalid", "no", { errors: ["robot.toml: a.", "lever.xml: b."] });
    await draft.add(whole);
    expect([draft.step.value, draft.errors.value.map(({ file }) => file)]).toEqual(["invalid", ["lever.xml", "robot.toml"]]);
    checker.failure = new ApiError(0, "unreachable", "The server cannot be reached.");
    await draft.check();
    expect([draft.step.value, draft.error.value, draft.errors.value]).toEqual(["unsent", "The server cannot be reached.", []]);
    checker.failure = new ApiError(409, "robot-type-built-in", "'ur5' comes with the installation.");
    await draft.check();
    expect([draft.step.value, draft.errors.value[0]?.file]).toEqual(["invalid", "robot.toml"]);
    expect(draft.files.value.size).toBe(4);
  });

  it("is not sent without a manifest or if it is too large", async () => {
    await draft.add(folder("lever.xml"));
    expect([draft.step.value, draft.localError.value]).toEqual(["invalid", "no-manifest"]);
    await draft.add(new Map([["robot.toml", bytes("x")], ["a.stl", new Uint8Array(7_000_000)]]));
    expect(draft.localError.value).toBe("too-large");
    await draft.clear();
    expect([draft.step.value, draft.localError.value, checker.checked.length]).toEqual(["empty", null, 0]);
  });

  it("discards a running check when a file changes", async () => {
    checker.open = 1000;
    const first = draft.add(whole);
    await new Promise((resolve) => setTimeout(resolve, 10));
    expect(draft.step.value).toBe("checking");
    checker.open = 1;
    await Promise.all([first, draft.remove("movements/bad.py")]);
    expect([draft.step.value, draft.files.value.size, draft.preview.value?.id]).toEqual(["valid", 3, "preview2"]);
    expect(checker.dropped).toEqual(["preview1"]);
    draft.dispose();
    expect(checker.dropped).toEqual(["preview1", "preview2"]);
  });
});
