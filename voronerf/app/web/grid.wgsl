
struct Level { scale: f32, shift: f32, side: u32, entries: u32, offset: u32, hashed: bool, half: u32 }

// Returns the entry of a corner within its level. A level without hashing has the indices 0 to `side` - 1 on each axis.
// A corner may have the index `side`; its entry may then lie beyond the end of the level, and wraps to the start.
fn corner_of(level: Level, corner: vec3u) -> u32 {
  if (level.hashed) {
    return (corner.x ^ (corner.y * 2654435761u) ^ (corner.z * 805459861u)) & (level.entries - 1u);
  }
  let entry = corner.x + level.side * (corner.y + level.side * corner.z);
  return select(entry - level.entries, entry, entry < level.entries);
}

// Interpolates the features of a level at a position in 0..1.
fn features_of(first: u32, inside: vec3f, level: Level) -> Features {
  let at = inside * level.scale + level.shift;
  let corner = vec3u(at);
  let upper = at - vec3f(corner);
  let lower = 1.0 - upper;
  var sum = Features();
  for (var i = 0u; i < 8u; i++) {
    let step = vec3u(i & 1u, (i >> 1u) & 1u, i >> 2u);
    let weights = select(lower, upper, step == vec3u(1));
    sum += weights.x * (weights.y * weights.z) * entry_of(first + level.offset + corner_of(level, corner + step), level.half);
  }
  return sum;
}
