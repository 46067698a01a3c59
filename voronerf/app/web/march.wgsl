// Marches rays through the occupied voxels of a grid up to the first surface, as voronerf.ops.render_opaque does. The
// constants above and `evaluate` below are generated from the run.

struct View {
  right: vec4f, up: vec4f, back: vec4f, origin: vec4f,  // axes and position of the camera
  lens: vec4f,   // focal lengths and principal point in pixels
  size: vec4u,   // width and height of the picture, first row to draw, one past the last row
  cut: vec4f,    // axis of the cut (3: none), and the largest coordinate on this axis that is shown
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> parameters: array<vec4u>;  // float16, cell after cell
@group(0) @binding(2) var<storage, read> table: array<u32>;         // float16, the hash grid
@group(0) @binding(3) var<storage, read> occupied: array<u32>;      // a bit per voxel
@group(0) @binding(4) var<storage, read> centres: array<vec4f>;     // x, y, z; bits of child diagram, or -1 - cell
@group(0) @binding(5) var<storage, read> diagrams: array<u32>;      // first centre of each diagram, and the end
@group(0) @binding(6) var<storage, read> hidden: array<u32>;        // a bit per cell
// Four words per pixel: colour times opacity and opacity as four float16; 1 + the visible cell (0: none); float depth.
@group(0) @binding(7) var<storage, read_write> pixels: array<vec4u>;

const NOTHING = 1e-20;

// Reads a block of a matrix: four outputs by four inputs.
fn block(at: u32) -> mat4x4f {
  let a = parameters[at];
  let b = parameters[at + 1u];
  return mat4x4f(
    vec4f(unpack2x16float(a.x), unpack2x16float(a.y)), vec4f(unpack2x16float(a.z), unpack2x16float(a.w)),
    vec4f(unpack2x16float(b.x), unpack2x16float(b.y)), vec4f(unpack2x16float(b.z), unpack2x16float(b.w)));
}

fn bias(first: u32, four: u32) -> vec4f {
  let word = parameters[first + four / 2u];
  let pair = select(word.xy, word.zw, four % 2u == 1u);
  return vec4f(unpack2x16float(pair.x), unpack2x16float(pair.y));
}

fn sigmoid(x: vec4f) -> vec4f { return 1.0 / (1.0 + exp(-clamp(x, vec4f(-60), vec4f(60)))); }
fn softplus(x: vec4f) -> vec4f { return max(x, vec4f()) + log(1.0 + exp(-abs(x))); }
// Reduces an angle to -pi..pi, where sine and cosine are accurate enough on every GPU.
fn turned(angle: vec4f) -> vec4f {
  let turns = round(angle * 0.15915494309189535);
  return (angle - turns * 6.28125) - turns * 0.0019353071795864769;
}

// Returns the distance at a fraction of the ray; the fraction is linear in the distance or in 1 / distance.
fn depth_of(near: f32, far: f32, share: f32) -> f32 {
  if (SPACING == 0u) { return near + (far - near) * share; }
  return near * far / max(far * (1.0 - share) + near * share, 1.17549435e-38);
}

// Maps a point into the space of the grid and the networks (voronerf.nerf.contraction).
fn contracted(point: vec3f) -> vec3f {
  if (CONTRACTION == 1u) {
    let offset = (point - SPHERE_CENTRE) * (1.0 / SPHERE_RADIUS);
    let inverse = 1.0 / max(length(offset), 1.0);
    return SPHERE_CENTRE + SPHERE_RADIUS * offset * ((2.0 - inverse) * inverse);
  }
  if (CONTRACTION == 2u) {
    let local = point - SPHERE_CENTRE;
    let depth = max(dot(local, AHEAD), PLANE.x / 2.0);
    return vec3f(dot(local, RIGHT) / (depth * PLANE.y), dot(local, UP) / (depth * PLANE.z), 1.0 - 2.0 * PLANE.x / depth);
  }
  return point;
}

fn is_occupied(place: vec3f) -> bool {
  let at = (place - GRID_BOX_LOW) * GRID_SCALE;
  if (!all(at >= vec3f()) || !all(at <= GRID_SIZE)) { return false; }
  let voxel = vec3u(min(at, GRID_SIZE - 1.0));
  let number = (voxel.x * u32(GRID_SIZE.y) + voxel.y) * u32(GRID_SIZE.z) + voxel.z;
  return ((occupied[number / 32u] >> (number % 32u)) & 1u) == 1u;
}

// Returns the cell of a position: descends the tree of diagrams to the nearest centre of each level.
fn cell_of(place: vec3f) -> u32 {
  var diagram = 0i;
  for (var level = 0u; level < LEVELS && diagram >= 0i; level++) {
    var nearest = 0u;
    var least = 3.4e38;
    let last = diagrams[diagram + 1i];
    for (var i = diagrams[diagram]; i < last; i++) {
      let away = place - centres[i].xyz;
      let distance = dot(away, away);
      if (distance < least) { least = distance; nearest = i; }
    }
    diagram = bitcast<i32>(centres[nearest].w);
  }
  return u32(max(-1i - diagram, 0i));
}

fn is_hidden(cell: u32) -> bool { return ((hidden[cell / 32u] >> (cell % 32u)) & 1u) == 1u; }

// Returns the distances at which a ray enters and leaves the scene's box; they are equal if the ray misses it.
fn way_of(origin: vec3f, direction: vec3f) -> vec2f {
  if (!BOXED) { return vec2f(NEAR, FAR); }
  let along = select(direction, vec3f(NOTHING), abs(direction) < vec3f(NOTHING));
  let a = (BOX_LOW - origin) / along;
  let b = (BOX_HIGH - origin) / along;
  let first = min(a, b);
  let last = max(a, b);
  let enter = clamp(max(first.x, max(first.y, first.z)), NEAR, FAR);
  return vec2f(enter, max(enter, clamp(min(last.x, min(last.y, last.z)), NEAR, FAR)));
}

// Returns the colour of a cut surface: the higher its opacity, the brighter.
fn density_colour(opacity: f32) -> vec3f {
  return mix(vec3f(0.16, 0.07, 0.36), vec3f(0.98, 0.86, 0.30), opacity);
}

@compute @workgroup_size(8, 8)
fn draw(@builtin(global_invocation_id) id: vec3u) {
  let x = id.x;
  let y = id.y + view.size.z;
  if (x >= view.size.x || y >= view.size.w) { return; }
  let across = (vec2f(f32(x), f32(y)) + 0.5 - view.lens.zw) / view.lens.xy;
  let direction = normalize(across.x * view.right.xyz - across.y * view.up.xyz - view.back.xyz);
  let origin = view.origin.xyz;
  let way = way_of(origin, direction);
  let near = way.x;
  let far = way.y;

  var front = 0.0;  // optical depth so far
  var colour = vec3f();
  var opacity = 0.0;
  var depth = 0.0;
  var most = 0.0;
  var seen = 0u;

  // The visible part of the ray: a cut (view.cut) hides points with a larger coordinate on its axis.
  var shown = vec2f(near, far);
  let axis = u32(view.cut.x);
  if (axis < 3u && far > near) {
    let towards = select(direction[axis], NOTHING, abs(direction[axis]) < NOTHING);
    let meets = (view.cut.y - origin[axis]) / towards;
    if (towards > 0.0) {
      shown.y = min(far, meets);
    } else if (meets > near) {
      shown.x = meets;
      let place = contracted(origin + meets * direction);
      if (meets < far && is_occupied(place)) {
        let cell = cell_of(place);
        if (!is_hidden(cell)) {
          front = min(evaluate(cell, place, direction).w, 1e30) * CUT_DEPTH;
          opacity = 1.0 - exp(-front);
          colour = opacity * density_colour(opacity);
          depth = opacity * meets;
          most = opacity;
          seen = cell + 1u;
        }
      }
    }
  }

  var stratum = select(STRATA, 0u, far > near);
  var first = near;  // the start of the stratum
  var samples = 0u;
  loop {
    // Finds the next stratum whose middle is in an occupied voxel.
    var last = first;
    var at = 0.0;
    var place = vec3f();
    var found = false;
    while (stratum < STRATA && !found) {
      first = last;
      last = select(depth_of(near, far, f32(stratum + 1u) / f32(STRATA)), far, stratum + 1u == STRATA);
      at = clamp(depth_of(near, far, (f32(stratum) + 0.5) / f32(STRATA)), first, last);
      place = contracted(origin + at * direction);
      found = is_occupied(place) && at >= shown.x && at <= shown.y;
      stratum++;
    }
    if (!found) { break; }
    let length = last - first;
    first = last;
    let cell = cell_of(place);
    if (is_hidden(cell)) { continue; }
    let field = evaluate(cell, place, direction);
    let optical = min(field.w, 1e30) * length;
    let weight = exp(-front) * (1.0 - exp(-optical));
    front += optical;
    colour += weight * field.rgb;
    opacity += weight;
    depth += weight * at;
    if (weight > most) { most = weight; seen = cell + 1u; }
    samples++;
    if (samples % WAVE == 0u && exp(-front) <= OPAQUE) { break; }
  }
  depth = select(far, depth / opacity, opacity > 0.0);
  if (exp(-front) <= OPAQUE) {  // the remaining light counts as the same colour
    colour /= opacity;
    opacity = 1.0;
  }
  pixels[y * view.size.x + x] = vec4u(
    pack2x16float(colour.rg), pack2x16float(vec2f(colour.b, opacity)), seen, bitcast<u32>(depth));
}
