#version 330 core
// Position and component id. The model stands in its own frame, so that no model matrix is needed; a product of matrix
// and vector costs a quarter of the product of two matrices that is taken for every vertex otherwise.
layout(location = 0) in vec3 position;
layout(location = COLOR_0_LOC) in vec4 color_0;
uniform mat4 V;
uniform mat4 P;
flat out vec4 component_color;

void main()
{
    component_color = color_0;
    gl_Position = P * (V * vec4(position, 1.0));
}
