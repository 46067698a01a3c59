// Shows a drawn picture on the screen: colour over a background, or the cells.

struct Screen {
  size: vec2f,         // size of the screen in pixels
  rough: vec2u,        // size of the coarse picture, drawn while the camera moved
  fine: vec2u,         // size of the sharp picture
  ready: u32,          // number of finished rows of the sharp picture
  cells: u32,          // 1: show the colours of the cells
  background: vec4f,   // colour; w = 0: a chessboard
}

@group(0) @binding(0) var<uniform> screen: Screen;
@group(0) @binding(1) var<storage, read> rough: array<vec4u>;
@group(0) @binding(2) var<storage, read> fine: array<vec4u>;
@group(0) @binding(3) var<storage, read> colours: array<u32>;

@vertex
fn corners(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
  return vec4f(select(-1.0, 3.0, i == 1u), select(-1.0, 3.0, i == 2u), 0, 1);  // a triangle around the screen
}

fn behind(at: vec2f) -> vec3f {
  if (screen.background.w > 0.0) { return screen.background.rgb; }
  let square = vec2u(at / 12.0);
  return vec3f(select(0.72, 0.82, (square.x + square.y) % 2u == 0u));
}

fn shown(pixel: vec4u, at: vec2f) -> vec3f {
  let blue = unpack2x16float(pixel.y);
  var colour = vec3f(unpack2x16float(pixel.x), blue.x);
  if (screen.cells == 1u && pixel.z > 0u) {
    let lightness = dot(clamp(colour + 1.0 - blue.y, vec3f(), vec3f(1)), vec3f(0.299, 0.587, 0.114));
    colour = blue.y * unpack4x8unorm(colours[pixel.z - 1u]).rgb * (0.4 + 0.6 * lightness);
  }
  return clamp(colour + (1.0 - blue.y) * behind(at), vec3f(), vec3f(1));
}

@fragment
fn show(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let at = position.xy / screen.size;
  let row = u32(at.y * f32(screen.fine.y));
  if (row < screen.ready) {
    let column = u32(at.x * f32(screen.fine.x));
    return vec4f(shown(fine[row * screen.fine.x + column], position.xy), 1);
  }
  // Bilinear interpolation of the coarse picture.
  let place = clamp(at * vec2f(screen.rough) - 0.5, vec2f(), vec2f(screen.rough - 1u));
  let first = vec2u(place);
  let last = min(first + 1u, screen.rough - 1u);
  let share = place - vec2f(first);
  let above = mix(shown(rough[first.y * screen.rough.x + first.x], position.xy),
                  shown(rough[first.y * screen.rough.x + last.x], position.xy), share.x);
  let below = mix(shown(rough[last.y * screen.rough.x + first.x], position.xy),
                  shown(rough[last.y * screen.rough.x + last.x], position.xy), share.x);
  return vec4f(mix(above, below, share.y), 1);
}
