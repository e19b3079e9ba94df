// A check of a value against a schema, as `curvafit.core.schema` has it; the schema itself comes with the page's data.

const BOUNDS = {
  minimum: (value, bound) => value >= bound,
  maximum: (value, bound) => value <= bound,
  exclusiveMinimum: (value, bound) => value > bound,
  exclusiveMaximum: (value, bound) => value < bound,
};

/** The first thing in a value that breaks a schema, as "mass as a number between -1 and 1, got 3"; null if nothing. */
function violation(value, schema, name = "the content") {
  if (!fits(value, schema)) return `${name} as ${schema.description}, got ${short(value)}`;
  const prefix = name === "the content" ? "" : `${name}.`;
  if (typeOf(value) === "object") {
    for (const key of schema.required ?? []) if (!Object.hasOwn(value, key)) return `${prefix}${key}, got none`;
    for (const [key, inner] of Object.entries(schema.properties ?? {})) {
      const wrong = Object.hasOwn(value, key) && violation(value[key], inner, prefix + key);
      if (wrong) return wrong;
    }
  }
  if (Array.isArray(value) && schema.items) {
    for (const [k, each] of value.entries()) {
      const wrong = violation(each, schema.items, `${name}[${k}]`);
      if (wrong) return wrong;
    }
  }
  return null;
}

/** Whether a value alone, without what is in it, is as its schema says. */
function fits(value, schema) {
  if (schema.enum) return schema.enum.includes(value);
  const kind = typeOf(value);
  if (![schema.type].flat().includes(kind)) return false;
  if (kind === "number") return Object.entries(BOUNDS).every(([name, holds]) => !(name in schema) || holds(value, schema[name]));
  return kind !== "array" || value.length >= (schema.minItems ?? 0);
}

/** JSON's name of a value's type; null for a number that is not finite. */
function typeOf(value) {
  if (value === null) return "null";
  if (Array.isArray(value)) return "array";
  return typeof value === "number" && !Number.isFinite(value) ? null : typeof value;
}

/** A value as an error quotes it. */
function short(value) {
  if (typeof value === "number") return String(value);
  const kind = typeOf(value);
  if (kind === "object" || kind === "array") return `an ${kind}`;
  const text = JSON.stringify(value);
  return text.length > 80 ? `${text.slice(0, 80)}…` : text;
}
