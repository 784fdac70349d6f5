#include "buffer.hpp"

#include <cstdint>
#include <new>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace invariode {
namespace {

#ifdef __linux__
/// The size from which on pages of 2 MB pay: the first touch of one costs a fraction of that of 512 small ones. (NumPy
/// requests them from 4 MB on too.)
constexpr std::size_t large = std::size_t{4} * 1024 * 1024, page = 4096;

/// A wish, which the system may ignore. It is for whole pages, the first one too: `realloc` moves a block that grows
/// without copying it if the advice is the same for all of it.
void ask_for_large_pages(void* block, std::size_t bytes) {
  const std::size_t inside = reinterpret_cast<std::uintptr_t>(block) % page;
  madvise(static_cast<char*>(block) - inside, bytes + inside, MADV_HUGEPAGE);
}
#endif

}  // namespace

void* resized_block(void* block, std::size_t bytes) {
  void* resized = std::realloc(block, bytes);
  if (resized == nullptr) throw std::bad_alloc();
#ifdef __linux__
  if (bytes >= large) ask_for_large_pages(resized, bytes);
#endif
  return resized;
}

}  // namespace invariode
