// World position and normal, and everything that is fixed to the skin at rest.
in vec3 position;
in vec3 normal;
in vec3 rest;
in vec3 rest_normal;
in vec4 paint;   // albedo, brow, hair, lip
in float wet;
uniform mat4 clip_from_world;
out vec3 world_position;
out vec3 world_normal;
out vec3 rest_position;
out vec3 rest_facing;
out vec4 vertex_paint;
out float vertex_wet;

void main() {
    world_position = position;
    world_normal = normal;
    rest_position = rest;
    rest_facing = rest_normal;
    vertex_paint = paint;
    vertex_wet = wet;
    gl_Position = clip_from_world * vec4(position, 1.0);
}
