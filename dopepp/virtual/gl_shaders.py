"""GLSL of the ``gl`` renderer: geometry, labels, shading, and the mean of a pixel's samples.

Shading follows, fragment by fragment, what the rasteriser computes in arrays: ``reflectance``
(Lambert, GGX, ambient light), ``lit`` (shadow maps), ``occlusion`` (baked open sky), ``noise`` and
``grooves``; each function names the module where its formula is derived.
"""

from __future__ import annotations

from typing import Final

HEADER: Final = "#version 430\n"

VERTEX: Final = """
uniform mat4 T_cam_obj;
uniform mat3 K;
uniform vec2 image_size;
uniform float near;
in vec3 in_position;
#ifdef SHADED
in vec3 in_normal;
in vec2 in_uv;
out vec3 normal;
out vec2 uv;
out vec2 share;
#endif
out vec3 position;

void main() {
    position = (T_cam_obj * vec4(in_position, 1.0)).xyz;
    vec3 hom = K * position;
    // Pixel (0, 0) is the centre of the first pixel; rows run as the image's do, so that what is
    // read back needs no flipping.
    gl_Position = vec4(2.0 * (hom.xy + 0.5 * hom.z) / image_size - hom.z,
                       hom.z - 2.0 * near, hom.z);
#ifdef SHADED
    normal = mat3(T_cam_obj) * in_normal;
    uv = in_uv;
    // Weights of the second and third corner.
    share = vec2(gl_VertexID % 3 == 1, gl_VertexID % 3 == 2);
#endif
}
"""

LABELS: Final = """
uniform int number;
uniform vec4 plane;
in vec3 position;
layout(location = 0) out int instance;
layout(location = 1) out float depth;

void main() {
    if (dot(plane.xyz, position) < plane.w) discard;
    instance = number;
    depth = position.z;
}
"""

SHADING: Final = """
uniform mat4 T_cam_obj;
uniform vec2 focal;
uniform vec4 plane;
uniform vec3 up, above, below;
uniform vec3 colour;
uniform float alpha0, specular, metallic;
uniform vec2 noise;               // amplitude, pitch
uniform vec3 groove_axis;         // camera frame
uniform vec4 groove;              // pitch, slope, irregularity, axis . origin
uniform bool textured;
uniform int num_lights;
uniform sampler2D image;
uniform sampler2DArray shadows;   // 1/m
uniform sampler3D lattice;        // in [-1, 1], 32 steps a side
// Per light: position and lift, colour at 1 m, three rows of the map's projection, its size.
layout(std430, binding = 0) readonly buffer Lights { vec4 lights[]; };
layout(std430, binding = 1) readonly buffer SkyGrids { ivec2 sky_grids[]; };  // steps, first
layout(std430, binding = 2) readonly buffer SkyValues { float sky_values[]; };
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec2 share;
out vec4 result;

// noise.tint_albedo
float tint() {
    float fade = noise.x > 0.0 ? 2.0 - position.z / (focal.x * noise.y) : 0.0;
    if (fade <= 0.0) return 1.0;
    vec3 object = transpose(mat3(T_cam_obj)) * (position - T_cam_obj[3].xyz);
    vec3 place = (object / noise.y + 0.5) / 32.0;
    return 1.0 + noise.x * min(fade, 1.0) * textureLod(lattice, place, 0.0).r;
}

float streak_step(int i) {
    return texelFetch(lattice, ivec3(i, i >> 5, i >> 10) & 31, 0).r;
}

// grooves.tilt_normals
void tilt(inout vec3 n, inout float alpha) {
    vec3 across = groove_axis - dot(groove_axis, n) * n;
    float z = position.z;
    float facing = min(dot(n, position), -1e-3 * z) / z;
    float shift = dot(groove_axis, position) / (z * facing);
    vec2 step = z / focal * (groove_axis.xy - shift * n.xy);
    float width = length(step) / groove.x, angle = 3.14159265 * width;
    float kept = width >= 1.0 ? 0.0 : (angle > 1e-3 ? sin(angle) / angle : 1.0);
    float lost = groove.y * groove.y * dot(across, across) * (1.0 - kept * kept);
    if (kept > 0.0) {
        float phase = (dot(groove_axis, position) - groove.w) / groove.x;
        float place = floor(2.0 * phase);
        float streak = mix(streak_step(int(place)), streak_step(int(place) + 1),
                           2.0 * phase - place);
        float wave = mix(sin(6.2831853 * fract(phase)), streak, groove.z);
        n = normalize(n - groove.y * kept * wave * across);
    }
    alpha = min(sqrt(alpha * alpha + 0.5 * lost), 1.0);
}

// occlusion.look_up_sky
float open_sky() {
    ivec2 grid = sky_grids[gl_PrimitiveID];
    int n = grid.x, base = grid.y + (gl_FrontFacing ? 0 : sky_values.length() / 2);
    vec2 place = float(n) * clamp(share, 0.0, 1.0);
    ivec2 cell = min(ivec2(place), n - 1);
    if (cell.x + cell.y > n - 1) {
        if (cell.x > 0) cell.x -= 1; else cell.y -= 1;
    }
    vec2 rest = place - vec2(cell);
    int low = base + cell.y * (n + 1) - cell.y * (cell.y - 1) / 2 + cell.x;
    int high = low + n + 1 - cell.y;
    if (rest.x + rest.y <= 1.0 || cell.x + cell.y == n - 1)
        return (1.0 - rest.x - rest.y) * sky_values[low] + rest.x * sky_values[low + 1]
             + rest.y * sky_values[high];
    return (rest.x + rest.y - 1.0) * sky_values[high + 1] + (1.0 - rest.x) * sky_values[high]
         + (1.0 - rest.y) * sky_values[low + 1];
}

// reflectance.reflect_ambient
vec3 ambient(vec3 n, vec3 albedo, float alpha) {
    float height = dot(n, up);
    float mirror = dot(up, reflect(normalize(position), n));
    float mirrored = clamp(0.5 + 0.5 * mirror / (0.1 + 0.9 * alpha), 0.0, 1.0);
    vec3 scattered = mix(below, above, 0.5 + 0.5 * height);
    return albedo * mix(scattered, mix(below, above, mirrored), metallic);
}

// lit.lit_shares
float lit(int k, vec3 n) {
    vec4 row = lights[6 * k + 4];
    vec3 from = lights[6 * k].xyz;
    if (dot(n, from - position) <= 0.0) return 0.0;
    float lift = lights[6 * k].w * (dot(row.xyz, position) + row.w);
    vec4 point = vec4(position + lift * n, 1.0);
    float inverse = 1.0 / dot(row, point);
    if (inverse <= 0.0) return 1.0;
    vec2 place = vec2(dot(lights[6 * k + 2], point), dot(lights[6 * k + 3], point)) * inverse;
    vec2 size = lights[6 * k + 5].xy;
    if (any(lessThan(place, vec2(0))) || any(greaterThanEqual(place, size - 1.0))) return 1.0;
    ivec3 texel = ivec3(ivec2(place), k);
    vec2 rest = place - vec2(texel.xy);
    vec4 drawn = vec4(texelFetch(shadows, texel, 0).r,
                      texelFetch(shadows, texel + ivec3(1, 0, 0), 0).r,
                      texelFetch(shadows, texel + ivec3(0, 1, 0), 0).r,
                      texelFetch(shadows, texel + ivec3(1, 1, 0), 0).r);
    vec4 open = vec4(lessThanEqual(drawn, vec4(inverse)));
    return mix(mix(open.x, open.y, rest.x), mix(open.z, open.w, rest.x), rest.y);
}

// reflectance.reflect_light
vec3 reflected(int k, vec3 n, vec3 albedo, float alpha) {
    vec3 l = lights[6 * k].xyz - position, v = -normalize(position);
    float square = dot(l, l) + 1e-6;
    l *= inversesqrt(square);
    float n_l = max(dot(n, l), 0.0), n_v = max(dot(n, v), 1e-3), l_v = dot(l, v);
    float scale = inversesqrt(2.0 + 2.0 * l_v + 1e-6);
    float n_h = min((n_l + n_v) * scale, 1.0), alpha2 = alpha * alpha;
    float d = n_h * n_h * (alpha2 - 1.0) + 1.0, q = 0.5 * alpha;
    float lobe = alpha2 / (d * d * 4.0 * (n_l * (1.0 - q) + q) * (n_v * (1.0 - q) + q));
    float grazing = pow(max(1.0 - (1.0 + l_v) * scale, 0.0), 5.0);
    vec3 upright = mix(vec3(specular), albedo, metallic);
    vec3 fresnel = upright + (1.0 - upright) * grazing;
    vec3 diffuse = (1.0 - metallic) * albedo * (1.0 - fresnel);
    return lit(k, n) * n_l / square * lights[6 * k + 1].rgb * (diffuse + fresnel * lobe);
}

// tone.TONE_CURVE
vec3 encoded(vec3 radiance) {
    vec3 bent = 1.0 - 0.5 * exp((0.5 - radiance) / 0.5);
    vec3 linear = mix(radiance, bent, greaterThan(radiance, vec3(0.5)));
    vec3 curved = 1.055 * pow(max(linear, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
    return mix(curved, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
}

void main() {
    if (dot(plane.xyz, position) < plane.w) discard;
    vec3 n = normalize(gl_FrontFacing ? normal : -normal);
    vec3 albedo = colour * tint();
    if (textured) albedo *= texture(image, vec2(uv.x, 1.0 - uv.y)).rgb;
    float alpha = alpha0;
    if (groove.y > 0.0) tilt(n, alpha);
    vec3 radiance = open_sky() * ambient(n, albedo, alpha);
    for (int k = 0; k < num_lights; ++k) radiance += reflected(k, n, albedo, alpha);
    result = vec4(encoded(clamp(radiance, 0.0, 4.0)), 1.0);
}
"""

FULL_SCREEN: Final = """
void main() {
    gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}
"""

RESOLVE: Final = """
uniform sampler2D samples;
uniform sampler2D background;
out vec4 result;

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec3 behind = texelFetch(background, pixel, 0).rgb, sum = vec3(0.0);
    for (int k = 0; k < 4; ++k) {
        vec4 one = texelFetch(samples, 2 * pixel + ivec2(k & 1, k >> 1), 0);
        sum += one.rgb + (1.0 - one.a) * behind;
    }
    result = vec4(sum / 4.0, 1.0);
}
"""
