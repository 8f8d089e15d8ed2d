// What the machine has left.
#pragma once

#include <cstdint>

namespace ngpt {

// Bytes that this process may still take before the system ends it: of the machine and of its container. The largest
// number where the system does not say.
uint64_t memory_left();

}  // namespace ngpt
