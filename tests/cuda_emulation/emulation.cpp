// The scheduler of the emulation: runs the fibers of a block in shuffled order. It is compiled without sanitizers, so
// that they see only the kernels' memory accesses. It reports fibers and their synchronisation to the sanitizers.
#include "emulation.h"

#include <cstdio>
#include <cstdlib>
#include <exception>
#include <map>
#include <memory>
#include <new>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include "fibers.h"

#ifndef __x86_64__
#include <ucontext.h>
#endif

namespace vn_emulation {

Index thread_index, block_index;
dim3 block_size, grid_size;

namespace {

constexpr size_t kStack = 32 * 1024;
constexpr unsigned kNoOrder = 1;         // a switch between fibers is no synchronisation
constexpr unsigned char kPoison = 0xff;  // NaN in float32, bfloat16 and float16, and -1 as an index
constexpr size_t kStaticShared = 48 * 1024;

bool racing() {
  return __tsan_create_fiber != nullptr;
}
void release(void* what) {
  if (racing()) __tsan_release(what);
}
void acquire(void* what) {
  if (racing()) __tsan_acquire(what);
}

enum class State { ready, at_barrier, at_meeting, done };

struct Fiber {
#ifdef __x86_64__
  void* stack_pointer = nullptr;
#else
  ucontext_t context;
#endif
  std::unique_ptr<unsigned char[]> stack;
  void* tsan = nullptr;
  void* fake_stack = nullptr;
  State state = State::ready;
  unsigned index = 0;
};

struct Warp {
  const char* operation = nullptr;
  unsigned arrived = 0;
  unsigned generation = 0;
  unsigned char slots[2][32 * kSlot];
  char order[2];  // addresses for ThreadSanitizer's synchronisation
};

// ThreadSanitizer's fiber objects of earlier launches, reused because creating one takes a millisecond.
std::vector<void*> idle_watches;

struct Block {
  std::vector<Fiber> fibers;
  std::vector<Warp> warps;
  unsigned waiting = 0, left = 0, generation = 0;
  char order[2];
  std::map<const void*, void*> shared;
  size_t shared_bytes = 0;
  void* dynamic = nullptr;

  Block(size_t threads, size_t bytes) : fibers(threads), warps(threads / 32) {
    for (unsigned i = 0; i < threads; ++i) fibers[i].index = i;
    // The buffer has exactly the requested size, so that AddressSanitizer guards its ends.
    if (bytes > 0) dynamic = poisoned(bytes);
  }
  ~Block() {
    for (const auto& [key, memory] : shared) std::free(memory);
    std::free(dynamic);
    for (const Fiber& fiber : fibers) {
      if (fiber.tsan != nullptr) idle_watches.push_back(fiber.tsan);
    }
  }
  Block(const Block&) = delete;
  Block& operator=(const Block&) = delete;

  static void* poisoned(size_t size) {
    void* memory = nullptr;
    if (posix_memalign(&memory, 128, size) != 0) throw std::bad_alloc();
    std::memset(memory, kPoison, size);
    return memory;
  }
};

// Stacks are reused, except under ThreadSanitizer, which would report accesses to a reused stack as races.
std::vector<std::unique_ptr<unsigned char[]>> idle_stacks;

struct Launch {
  void (*run)(void*) = nullptr;
  void* context = nullptr;
  Block* block = nullptr;
  Fiber main;
  Fiber* current = nullptr;
  std::string error;
  char begin, end;
};

Launch* launching = nullptr;
const void* main_stack = nullptr;
size_t main_size = 0;

void switch_to(Fiber& from, Fiber& to, bool leaving) {
  if (__sanitizer_start_switch_fiber != nullptr) {
    const bool to_main = &to == &launching->main;
    __sanitizer_start_switch_fiber(leaving ? nullptr : &from.fake_stack, to_main ? main_stack : to.stack.get(),
                                   to_main ? main_size : kStack);
  }
  if (racing()) __tsan_switch_to_fiber(to.tsan, kNoOrder);
#ifdef __x86_64__
  vn_switch(&from.stack_pointer, to.stack_pointer);
#else
  swapcontext(&from.context, &to.context);
#endif
  if (__sanitizer_finish_switch_fiber != nullptr) {
    __sanitizer_finish_switch_fiber(from.fake_stack, nullptr, nullptr);
  }
}

void yield() {
  switch_to(*launching->current, launching->main, false);
}

void body() {
  Launch& it = *launching;
  if (__sanitizer_finish_switch_fiber != nullptr) {
    const void* bottom = nullptr;
    size_t size = 0;
    __sanitizer_finish_switch_fiber(nullptr, &bottom, &size);
    if (main_stack == nullptr) main_stack = bottom, main_size = size;
  }
  acquire(&it.begin);
  try {
    it.run(it.context);
  } catch (const std::exception& error) {
    it.error = error.what();
  }
  release(&it.end);
  it.current->state = State::done;
  ++it.block->left;
  switch_to(*it.current, it.main, true);
  std::abort();
}

void prepare(Fiber& fiber) {
  if (idle_stacks.empty()) {
    fiber.stack.reset(new unsigned char[kStack]);
  } else {
    fiber.stack = std::move(idle_stacks.back());
    idle_stacks.pop_back();
  }
#ifdef __x86_64__
  auto top = reinterpret_cast<uintptr_t>(fiber.stack.get() + kStack) & ~uintptr_t{15};
  auto* words = reinterpret_cast<void**>(top);
  *--words = nullptr;                         // aligns the stack as after a call
  *--words = reinterpret_cast<void*>(&body);  // the address to which vn_switch returns
  for (int i = 0; i < 6; ++i) *--words = nullptr;
  fiber.stack_pointer = words;
#else
  getcontext(&fiber.context);
  fiber.context.uc_stack.ss_sp = fiber.stack.get();
  fiber.context.uc_stack.ss_size = kStack;
  fiber.context.uc_link = nullptr;
  makecontext(&fiber.context, &body, 0);
#endif
  if (racing()) {
    if (idle_watches.empty()) idle_watches.push_back(__tsan_create_fiber(0));
    fiber.tsan = idle_watches.back();
    idle_watches.pop_back();
  }
  if (__asan_unpoison_memory_region != nullptr) __asan_unpoison_memory_region(fiber.stack.get(), kStack);
  fiber.state = State::ready;
}

// Runs a block in rounds. In a round, every fiber that can go on runs to its next operation of the warp or the block,
// in shuffled order. `ahead`: a warp runs to its next barrier of the block before the other warps. Otherwise a missing
// __syncthreads does not show if the code before it ends in a warp operation, after which all warps are in step.
void run_block(Launch& it, Block& block, std::mt19937_64& random, bool ahead) {
  const auto threads = static_cast<unsigned>(block.fibers.size());
  std::vector<unsigned> order(threads), warps(threads / 32);
  for (unsigned i = 0; i < threads; ++i) order[i] = i;
  for (unsigned i = 0; i < threads / 32; ++i) warps[i] = i;
  // Runs a round of some fibers. Returns whether any of them could go on.
  const auto round = [&](unsigned first, unsigned count) {
    std::shuffle(order.begin() + first, order.begin() + first + count, random);
    bool moved = false;
    for (unsigned place = first; place < first + count && it.error.empty(); ++place) {
      const unsigned i = order[place];
      Fiber& fiber = block.fibers[i];
      if (fiber.state != State::ready) continue;
      moved = true;
      it.current = &fiber;
      thread_index = {i % block_size.x, i / block_size.x % block_size.y, i / (block_size.x * block_size.y)};
      switch_to(it.main, fiber, false);
    }
    return moved;
  };
  while (block.left < threads && it.error.empty()) {
    bool moved = false;
    if (ahead) {
      std::shuffle(warps.begin(), warps.end(), random);
      for (const unsigned warp : warps) {
        while (round(32 * warp, 32)) moved = true;
      }
    } else {
      moved = round(0, threads);
    }
    if (moved) continue;
    const bool barrier = block.waiting > 0;
    it.error = barrier ? "__syncthreads is not reached by every thread of the block"
                       : "an operation of a warp is not reached by all of its lanes";
  }
}

}  // namespace

Settings& settings() {
  static Settings kept;
  return kept;
}

Watcher& watcher() {
  static Watcher kept;
  return kept;
}

int lane() {
  return static_cast<int>(launching->current->index % 32);
}

void fail(const std::string& message) {
  throw std::runtime_error(message);
}

void require_all(unsigned mask) {
  if (mask != 0xffffffffu) fail("the emulation has no partial warps");
}

void block_barrier() {
  Block& block = *launching->block;
  char* order = &block.order[block.generation % 2];
  release(order);
  if (++block.waiting == block.fibers.size()) {
    block.waiting = 0;
    ++block.generation;
    for (Fiber& fiber : block.fibers) fiber.state = State::ready;
  } else {
    launching->current->state = State::at_barrier;
  }
  yield();
  acquire(order);
}

const unsigned char* meet(const char* operation, const void* mine, size_t size, bool ordered) {
  Block& block = *launching->block;
  const unsigned index = launching->current->index;
  Warp& warp = block.warps[index / 32];
  if (size > kSlot) fail(std::string(operation) + " hands over too much");
  if (warp.arrived > 0 && std::strcmp(warp.operation, operation) != 0) {
    fail(std::string("lanes of a warp meet in ") + warp.operation + " and in " + operation);
  }
  warp.operation = operation;
  const unsigned side = warp.generation % 2;
  unsigned char* slots = warp.slots[side];
  // Copies byte by byte, because ThreadSanitizer intercepts memcpy even in uninstrumented code.
  volatile unsigned char* slot = slots + (index % 32) * kSlot;
  for (size_t i = 0; i < size; ++i) slot[i] = static_cast<const unsigned char*>(mine)[i];
  if (ordered) release(&warp.order[side]);
  if (++warp.arrived == 32) {
    warp.arrived = 0;
    ++warp.generation;
    for (unsigned i = 0; i < 32; ++i) block.fibers[index / 32 * 32 + i].state = State::ready;
  } else {
    launching->current->state = State::at_meeting;
  }
  yield();
  if (ordered) acquire(&warp.order[side]);
  return slots;
}

void* shared(const void* key, size_t size) {
  Block& block = *launching->block;
  void*& memory = block.shared[key];
  if (memory == nullptr) {
    block.shared_bytes += size;
    if (block.shared_bytes > kStaticShared) fail("more than 48 KiB of static shared memory");
    memory = Block::poisoned(size);
  }
  return memory;
}

void* dynamic_shared() {
  return launching->block->dynamic;
}

// The number of launches so far, for tests.
static int64_t launched = 0;
int64_t launches() {
  return launched;
}

void launch(void (*run)(void*), void* context, dim3 grid, dim3 block_of, size_t dynamic_bytes) {
  const size_t threads = size_t{block_of.x} * block_of.y * block_of.z;
  if (grid.x == 0 || grid.y == 0 || grid.z == 0) fail("a grid without blocks");
  if (grid.y > 65535 || grid.z > 65535 || grid.x > 0x7fffffffu) fail("a grid that is too large");
  if (threads == 0 || threads > 1024) fail("a block of " + std::to_string(threads) + " threads");
  if (threads % 32 != 0) fail("a block that is not of whole warps");
  // Every device provides 48 KiB by default.
  if (dynamic_bytes > std::max<size_t>(kStaticShared, settings().shared))
    fail("more shared memory than a block may have");
  ++launched;
  Launch it;
  it.run = run;
  it.context = context;
  launching = &it;
  if (racing()) it.main.tsan = __tsan_get_current_fiber();
  release(&it.begin);
  grid_size = grid;
  block_size = block_of;
  std::mt19937_64 random(settings().seed);
  std::vector<unsigned> blocks(size_t{grid.x} * grid.y * grid.z);
  for (size_t i = 0; i < blocks.size(); ++i) blocks[i] = static_cast<unsigned>(i);
  std::shuffle(blocks.begin(), blocks.end(), random);
  std::vector<std::unique_ptr<Block>> kept;
  for (const unsigned number : blocks) {
    block_index = {number % grid.x, number / grid.x % grid.y, number / (grid.x * grid.y)};
    kept.push_back(std::make_unique<Block>(threads, dynamic_bytes));
    Block& block = *kept.back();
    for (Fiber& fiber : block.fibers) prepare(fiber);
    it.block = &block;
    run_block(it, block, random, (number + settings().seed) % 2 == 1);
    if (!it.error.empty()) break;
    // Under ThreadSanitizer a launch reuses no memory, since its blocks are not synchronised.
    if (racing()) continue;
    for (Fiber& fiber : block.fibers) idle_stacks.push_back(std::move(fiber.stack));
    kept.clear();
  }
  acquire(&it.end);
  launching = nullptr;
  if (!it.error.empty()) fail(it.error);
}

}  // namespace vn_emulation
