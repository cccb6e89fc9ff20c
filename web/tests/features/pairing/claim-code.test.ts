/** Claim codes as people type them and links carry them. */
import { describe, expect, it } from "vitest";
import { FollowedCode, pairingCode, readCode } from "../../../src/features/pairing/model/claim-code";

describe("a claim code", () => {
  it.each(["BCDF-GHJK", "bcdfghjk", " bcdf ghjk ", "BCDF–GHJK"])("is read as it is typed: %s", (typed) => {
    expect(readCode(typed)).toBe("BCDF-GHJK");
  });

  it.each(["", "BCDF-GHJ", "BCDF-GHJKL", "ABCD-EFGH", "BCDF-GH1K"])("is none: %s", (typed) => {
    expect(readCode(typed)).toBeNull();
  });

  it("is taken from a link's fragment, and from nothing that only begins so", () => {
    expect(pairingCode("#pair=BCDF-GHJK")).toBe("BCDF-GHJK");
    expect(pairingCode("#pair=bcdfghjk")).toBe("BCDF-GHJK");
    for (const hash of ["", "#/", "#pair=", "#pair=BCDF-GHJK&x=1", "#pair=<b>BCDFGHJK", "#x#pair=BCDF-GHJK"]) {
      expect(pairingCode(hash)).toBeNull();
    }
  });

  it("that was followed is there again after signing in elsewhere, until it is used", () => {
    const kept = new Map<string, string>();
    const shelf = {
      getItem: (key: string) => kept.get(key) ?? null,
      setItem: (key: string, value: string) => void kept.set(key, value),
      removeItem: (key: string) => void kept.delete(key),
    };
    new FollowedCode(shelf).follow("BCDF-GHJK");
    const back = new FollowedCode(shelf);
    expect(back.code.value).toBe("BCDF-GHJK");
    back.drop();
    expect(new FollowedCode(shelf).code.value).toBeNull();
  });
});
